"""Photographs at the size that silhouettes are looked for in."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.mapped import stacked, zeros
from pimper_torch.parallel import side_by_side
from pimper_torch.radiometry.response import srgb_from_linear
from pimper_torch.records import Cameras, Record, Views
from pimper_torch.silhouettes.opencv import shrunk

_BRIGHT = 0.99  # this quantile of each photograph's radiance is shown white
_FAINT = 0.03  # of white; ratios of darker colours tell noise
_RATIO = 100.0  # grey levels for a ratio of e
_DARK = 0.005  # of white; logarithms of what is darker tell noise


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class WorkingPictures(Record):
    """Photographs in display colours, reduced.

    Attributes:
        colours: Encoded as sRGB, exposed alike; padding is black.
        opponent: Brightness and two ratios of colours, which shadows change little.
        grey: Logarithm of the mean radiance.
        factors: Size of these pictures over that of the photographs, across and down.
    """

    colours: UInt8[Tensor, "view height width 3"]
    opponent: UInt8[Tensor, "view height width 3"]
    grey: Float[Tensor, "view height width"]
    cameras: Cameras
    factors: tuple[float, float]


def working_pictures(views: Views, cameras: Cameras, size_px: int) -> WorkingPictures:
    """Shrink photographs so that the longer side of the raster is at most so long."""
    height, width = views.images.shape[-2:]
    factor = min(1.0, size_px / max(height, width))
    wide, high = max(1, round(factor * width)), max(1, round(factor * height))
    factors = (wide / width, high / height)

    def shown(image: Float[Tensor, "channel _ _"]) -> tuple[Tensor, Tensor, Tensor]:
        small = shrunk(image, wide, high)
        level = torch.quantile(small.mean(dim=0).flatten()[::7], _BRIGHT).clamp_min(1e-6)
        radiance = (small / level).clamp(0, 1).expand(3, -1, -1)
        colours = (255 * srgb_from_linear(radiance)).round().byte().permute(1, 2, 0)
        return colours, _opponent(radiance), torch.log(small.mean(dim=0) / level + _DARK)

    images = views.images.detach().cpu().unbind()
    colours, opponent = (zeros((len(images), high, wide, 3), torch.uint8) for _ in range(2))
    grey = zeros((len(images), high, wide))
    for view, layers in enumerate(side_by_side(shown, images, tracked=False)):
        colours[view], opponent[view], grey[view] = layers
    scale = torch.tensor(factors)
    return WorkingPictures(
        colours=colours,
        opponent=opponent,
        grey=grey,
        cameras=cameras.to("cpu", torch.float32).replace(
            intrinsics=scale_intrinsics(cameras.intrinsics.cpu().float(), *factors),
            sizes_px=(cameras.sizes_px.cpu() * scale).round().long().clamp_min(1),
        ),
        factors=factors,
    )


def of_views(work: Callable[[int], Tensor], count: int) -> Tensor:
    """Stack what is computed of every view by itself."""
    return stacked(side_by_side(work, range(count)), count)


def _opponent(radiance: Float[Tensor, "3 height width"]) -> UInt8[Tensor, "height width 3"]:
    """Return brightness and two ratios of colours, which shadows and shading leave as they are."""
    red, green, blue = torch.log(radiance + _FAINT)
    luma = 255 * srgb_from_linear(radiance.mean(dim=0))
    ratios = [128 + _RATIO * (red - green), 128 + _RATIO * (blue - green)]
    return torch.stack([luma, *ratios], dim=-1).clamp(0, 255).round().byte()
