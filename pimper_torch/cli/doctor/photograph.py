"""Measurements of a photograph: blur, saturation, exposure, and a small copy."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn.functional import max_pool2d

from pimper_torch.io.photographs import shrunk_size
from pimper_torch.io.radiance import resized, resized_mask, resized_radiance
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import Record, Views
from pimper_torch.records.shapes import Map, Mask
from pimper_torch.runtime.parallel import side_by_side

# Smoothing of the two compared gradients, in pixels: above noise, below the blur to detect.
_FINE, _WIDE = 1.0, 2.0


def edge_blur_px(grey: Map) -> float:
    r"""Return the standard deviation of the blur at the strongest edges, in pixels.

    An ideal edge under a Gaussian blur of variance :math:`s^2` has, after smoothing with variances
    :math:`a^2` and :math:`b^2`, gradients in the ratio
    :math:`R^2 = (s^2 + b^2) / (s^2 + a^2)`, so that :math:`s^2 = (b^2 - R^2 a^2) / (R^2 - 1)`.
    The most blurred orientation counts, as motion blurs edges across it only. NaN without edges.

    Source: Zhuo & Sim, Defocus map estimation from a single image, Pattern Recognition 44, 2011.
    """
    fine, wide = _gradient(grey, _FINE), _gradient(grey, _WIDE)
    strength = torch.hypot(*fine)
    peaks = max_pool2d(strength[None, None], 3, 1, 1)[0, 0] == strength
    peaks &= strength > 6 * strength.median() + 1e-4  # else noise
    angle = torch.atan2(fine[1], fine[0]) % torch.pi
    bins = (angle * (4 / torch.pi) + 0.5).floor() % 4
    blurs = [_blur(strength, torch.hypot(*wide), peaks & (bins == index)) for index in range(4)]
    return max((blur for blur in blurs if not math.isnan(blur)), default=float("nan"))


def _blur(fine: Map, wide: Map, edges: Mask) -> float:
    strength, smoothed = fine[edges], wide[edges]
    if len(strength) < 40:
        return float("nan")
    strongest = strength.topk(min(400, len(strength))).indices
    ratio = (strength[strongest] / smoothed[strongest]).square().clamp_min(1 + 1e-6)
    # Central differences over two pixels are a box of variance 1 / 3.
    a, b = _FINE**2 + 1 / 3, _WIDE**2 + 1 / 3
    variance = ((b - ratio * a) / (ratio - 1)).clamp_min(0)
    return float(variance.median().sqrt())


def _gradient(grey: Map, sigma: float) -> Float[Tensor, "2 height_in width_in"]:
    smooth = torch.from_numpy(gaussian_filter(grey.numpy(), sigma, mode="nearest"))
    across = (smooth[1:-1, 2:] - smooth[1:-1, :-2]) / 2
    down = (smooth[2:, 1:-1] - smooth[:-2, 1:-1]) / 2
    return torch.stack([across, down])


EXAMINED_PX = 1024  # longer side, at which a blur of a pixel at 2000 is still measured
_SMALL_PX = 600  # longer side of the small copy, which connects the demo's photographs


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Photograph(Record):
    """Measurements of one photograph.

    Attributes:
        width: Width in pixels in the run.
        bright: Radiance that 1 % of the pixels exceed; 1 is saturation.
        blur_px: Standard deviation of the blur at the strongest edges in the run; NaN without any.
        small: Small copy, mean of the colour channels.
    """

    name: str
    width: int
    height: int
    saturated: float
    bright: float
    blur_px: float
    small: Float[Tensor, "rows columns"]


def summarize(
    name: str,
    radiance: Float[Tensor, "channel height width"],
    mask: Mask | None = None,
    size_px: tuple[int, int] | None = None,
) -> Photograph:
    """Return the measurements of linear radiance; saturation only counts inside the mask.

    The size is that of the run, by default that of the radiance.
    """
    height, width = radiance.shape[-2:]
    size_px = size_px or (width, height)
    sides = shrunk_size(width, height, EXAMINED_PX)
    radiance = resized_radiance(radiance, *sides)
    saturated = radiance.amax(dim=0) >= SATURATED
    if mask is not None:
        saturated = saturated[resized_mask(mask.float(), *sides)]
    small = resized(radiance, *shrunk_size(*sides, _SMALL_PX))
    highest = small.amax(dim=0)
    return Photograph(
        name=name,
        width=size_px[0],
        height=size_px[1],
        saturated=float(saturated.sum()) / max(1, saturated.numel()),
        bright=float(highest.flatten().kthvalue(math.ceil(0.99 * highest.numel())).values),
        blur_px=edge_blur_px(radiance.mean(dim=0)) * max(size_px) / max(sides),
        small=small.mean(dim=0),
    )


def summarize_views(
    views: Views, sizes_px: Mapping[str, tuple[int, int]] | None = None
) -> list[Photograph]:
    """Return the measurements of loaded photographs, with their sizes in the run by name."""

    def measure(index: int) -> Photograph:
        width, height = views.sizes_px[index].tolist()
        image = views.images[index, :, :height, :width].detach().cpu().float()
        mask = None if views.masks is None else views.masks[index, :height, :width].cpu()
        name = views.names[index]
        return summarize(name, image, mask, sizes_px[name] if sizes_px else None)

    with torch.no_grad():
        return list(side_by_side(measure, range(views.num_views), tracked=False))
