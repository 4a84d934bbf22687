"""Matching of views through a surface under any light, by correlation of windows.

A surface is a field of inverse depths over a view. Every source view is resampled once through the
field, and windows of the view and the resampled images are compared. Windows thus follow the slant
and curvature of the field, for one sample per pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from pimper_torch.geometry.pixels import pixel_centers, scale_intrinsics
from pimper_torch.kernels.arrays import as_array
from pimper_torch.records import Cameras, Record, SparseScene
from pimper_torch.records.shapes import Map, Maps, Masks
from pimper_torch.runtime.mapped import by_view, each


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MatchingLevel(Record):
    """All photographs at one resolution.

    Attributes:
        tone: Square root of gray radiance plus a hundredth, so that noise is about uniform; about 1
            at the 98th percentile of the usable pixels of all photographs.
        usable: False outside photographs and masks.
    """

    tone: Maps
    usable: Masks
    cameras: Cameras


def level_of(scene: SparseScene, factor: int) -> MatchingLevel:
    """Reduce the photographs by an integer factor; right and bottom remainders are cut off."""
    views, cameras = scene.views, scene.cameras
    usable = views.inside
    if views.masks is not None:
        usable = by_view(torch.logical_and, usable, views.masks)

    def reduced(image: Float[Tensor, "channel _ _"]) -> Float[Tensor, "_ _"]:
        gray = image.mean(dim=0, keepdim=True).nan_to_num(0, 0, 0)
        return avg_pool2d(gray, factor)[0].clamp_min(0)

    gray = by_view(reduced, views.images)
    # All pixels of a reduced pixel must be usable; the tolerance covers the rounding of the mean.
    usable = by_view(lambda mask: avg_pool2d(mask[None].to(gray), factor)[0] > 1 - 1e-4, usable)
    values = torch.cat([image[mask] for image, mask in each(gray, usable)])
    values = values if len(values) else gray.reshape(-1)
    # Brighter pixels are highlights.
    rank = min(len(values), int(0.98 * len(values)) + 1)
    percentile = np.partition(values.cpu().numpy(), rank - 1)[rank - 1]
    bright = max(float(percentile), torch.finfo(gray.dtype).tiny)
    return MatchingLevel(
        # The offset bounds the amplification of noise in black pixels.
        tone=by_view(lambda image: (image / bright + 0.01).sqrt(), gray),
        usable=usable,
        cameras=cameras.replace(
            intrinsics=scale_intrinsics(cameras.intrinsics, 1 / factor, 1 / factor),
            sizes_px=cameras.sizes_px // factor,
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Pairing(Record):
    r"""A view and the source views that it is matched with.

    A pixel with inverse depth q projects into source s at the homogeneous pixel
    :math:`A_s (u, v, 1)^T + q \, b_s`.

    Attributes:
        ray: ``A_s (u, v, 1)`` of every pixel of the view, or of a subset.
        shift: ``b_s``.
    """

    view: int
    sources: Int[Tensor, " source"]
    ray: Float[Tensor, "source 3 *pixel"]
    shift: Float[Tensor, "source 3"]

    def project(
        self, inverse_depth: Float[Tensor, "*pixel"]
    ) -> tuple[Float[Tensor, "source 2 *pixel"], Float[Tensor, " source *pixel"]]:
        """Return the pixels in the sources, and the depth there over the depth in the view."""
        image = self.ray + self.shift.reshape(-1, 3, *(1,) * inverse_depth.dim()) * inverse_depth
        ratio = image[:, 2]
        return image[:, :2] / ratio.clamp_min(1e-6)[:, None], ratio


View = int | Int[Tensor, " view"]


def pixels_from_pixels(
    cameras: Cameras, to: View, start: View
) -> tuple[Float[Tensor, "pair 3 3"], Float[Tensor, "pair 3"]]:
    """Return ``A`` and ``b`` of :class:`Pairing` in double precision; one argument is an index."""
    frames, intrinsics = cameras.cam_from_world.double(), cameras.intrinsics.double()
    relative = frames[to] @ torch.linalg.inv(frames[start])
    rotation = intrinsics[to] @ relative[:, :3, :3] @ torch.linalg.inv(intrinsics[start])
    return rotation, (intrinsics[to] @ relative[:, :3, 3:])[..., 0]


def pair(level: MatchingLevel, view: int, sources: Int[Tensor, " source"]) -> Pairing:
    """Return the pairing of a view with its sources."""
    height, width = level.tone.shape[-2:]
    rotation, shift = pixels_from_pixels(level.cameras, sources, view)
    pixels = pixel_centers(width, height, like=rotation)
    u, v = pixels[0, :, 0], pixels[:, 0, 1]
    across, down = rotation[:, :, :1] * u, rotation[:, :, 1:2] * v + rotation[:, :, 2:]
    return Pairing(
        view=view,
        sources=sources,
        ray=(down[..., None] + across[:, :, None]).to(level.tone),
        shift=shift.to(level.tone),
    )


# Comparison of windows; choices.
RADIUS = 2  # windows have 2 * RADIUS + 1 pixels a side
_LIKENESS = 0.2  # difference of tone to the centre at which the weight of a pixel is 0.6
_CONTRAST = 0.005  # standard deviation of the tone in a window below which its correlation fades
_BEST = 3  # number of sources that count at each pixel, the best ones


class Matcher:
    """Normalized cross-correlation of windows of a view and its sources, through any field.

    Source: Yoon & Kweon, Adaptive support-weight approach, PAMI 28(4), 2006, for the weights;
    Schönberger et al., Pixelwise view selection, ECCV 2016, for correlation with them.
    """

    def __init__(self, level: MatchingLevel, pairing: Pairing) -> None:
        tone = level.tone[pairing.view].detach().float()
        usable = level.usable[pairing.view]
        around = torch.stack(shifted(tone, RADIUS, "replicate"))
        along = torch.exp(-(torch.arange(-RADIUS, RADIUS + 1) / RADIUS).square() / 2)
        spatial = (along[:, None] * along).reshape(-1, 1, 1).to(tone)
        weight = spatial * torch.exp(-((around - tone) / _LIKENESS).square() / 2)
        weight *= torch.stack(shifted(usable.to(tone), RADIUS, "replicate"))
        weight /= weight.sum(dim=0).clamp_min(1e-12)
        # Centred first: single precision has no digits for a difference of large numbers.
        around -= (weight * around).sum(dim=0)
        deviation = weight * around
        power = (deviation * around).sum(dim=0)
        arrays = pairing.ray, pairing.shift, level.tone[pairing.sources]
        self._ray, self._shift, self._tone = (as_array(array, torch.float32) for array in arrays)
        self._source_usable = as_array(level.usable[pairing.sources])
        self._view_usable = as_array(usable)
        self._weight, self._deviation, self._power = map(as_array, (weight, deviation, power))

    def scores(self, field: Map, offsets: Sequence[float]) -> Float[Tensor, "offset height width"]:
        """Return the scores of a field of inverse depths plus each offset.

        The score is the mean correlation of the best sources, 0 where none sees the pixel.
        Computed on the CPU in single precision; not differentiable.
        """
        from pimper_torch.stages.coarse.kernels.window_scores import window_scores

        scores = torch.empty(len(offsets), *field.shape)
        window_scores(
            as_array(field, torch.float32),
            np.array(offsets, dtype=np.float32),
            self._ray,
            self._shift,
            self._tone,
            self._source_usable,
            self._weight,
            self._deviation,
            self._power,
            self._view_usable,
            _CONTRAST**2,
            _BEST,
            scores.numpy(),
        )
        return scores.to(field)


def shifted(values: Map, radius: int, padding: Literal["replicate", "constant"]) -> list[Map]:
    """Return a map per pixel of a window: the values shifted by that pixel's offset."""
    height, width = values.shape
    wide = pad(values[None, None], (radius,) * 4, mode=padding)[0, 0]
    side = range(2 * radius + 1)
    return [wide[row : row + height, column : column + width] for row in side for column in side]
