"""Match of views through a surface, under any light: correlation of windows.

A surface is a field of inverse depths over a view. Every source view is looked up once
through the field, and windows are compared in what comes back: they are slanted and bent as
the field is, at the price of one sample a pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from pimper_torch.ground.geometry.pixels import pixel_centers, scale_intrinsics
from pimper_torch.ground.kernels.arrays import as_array
from pimper_torch.ground.shapes import Map, Maps, Masks
from pimper_torch.records import Cameras, Record, SparseScene
from pimper_torch.runtime.mapped import by_view, each


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MatchingLevel(Record):
    """All photographs at one resolution.

    Attributes:
        tone: Root of gray radiance, so that noise is about the same everywhere; about 1 at
            the photographs' bright level.
        usable: False outside photographs and masks.
    """

    tone: Maps
    usable: Masks
    cameras: Cameras


def level_of(scene: SparseScene, factor: int) -> MatchingLevel:
    """Reduce the photographs by a whole factor; remainders at the right and the bottom are cut."""
    views, cameras = scene.views, scene.cameras
    usable = views.inside
    if views.masks is not None:
        usable = by_view(torch.logical_and, usable, views.masks)

    def reduced(image: Float[Tensor, "channel _ _"]) -> Float[Tensor, "_ _"]:
        gray = image.mean(dim=0, keepdim=True).nan_to_num(0, 0, 0)
        return avg_pool2d(gray, factor)[0].clamp_min(0)

    gray = by_view(reduced, views.images)
    # All of a reduced pixel has to be usable: the smallest value is that of the pool's.
    usable = by_view(lambda one: avg_pool2d(one[None].to(gray), factor)[0] > 1 - 1e-4, usable)
    shown = torch.cat([one[lit] for one, lit in each(gray, usable)])
    shown = shown if len(shown) else gray.reshape(-1)
    # Above it lie highlights.
    rank = min(len(shown), int(0.98 * len(shown)) + 1)
    level = np.partition(shown.cpu().numpy(), rank - 1)[rank - 1]
    bright = max(float(level), torch.finfo(gray.dtype).tiny)
    return MatchingLevel(
        # The noise of black pixels is not stretched without limit.
        tone=by_view(lambda one: (one / bright + 0.01).sqrt(), gray),
        usable=usable,
        cameras=cameras.replace(
            intrinsics=scale_intrinsics(cameras.intrinsics, 1 / factor, 1 / factor),
            sizes_px=cameras.sizes_px // factor,
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Pairing(Record):
    r"""One view and those it is matched with.

    A pixel with inverse depth q is seen by source s at the pixel that
    :math:`A_s (u, v, 1)^T + q \, b_s` is the homogeneous form of.

    Attributes:
        ray: ``A_s (u, v, 1)`` of every pixel of the view, or of some.
        shift: ``b_s``.
    """

    view: int
    sources: Int[Tensor, " source"]
    ray: Float[Tensor, "source 3 *pixel"]
    shift: Float[Tensor, "source 3"]

    def look(
        self, inverse_depth: Float[Tensor, "*pixel"]
    ) -> tuple[Float[Tensor, "source 2 *pixel"], Float[Tensor, " source *pixel"]]:
        """Project pixels into the sources; also give depth there over depth here."""
        at = self.ray + self.shift.reshape(-1, 3, *(1,) * inverse_depth.dim()) * inverse_depth
        ratio = at[:, 2]
        return at[:, :2] / ratio.clamp_min(1e-6)[:, None], ratio


View = int | Int[Tensor, " view"]


def pixels_from_pixels(
    cameras: Cameras, to: View, start: View
) -> tuple[Float[Tensor, "pair 3 3"], Float[Tensor, "pair 3"]]:
    """Return ``A`` and ``b`` of :class:`Pairing`, in double precision: of one view and many."""
    frames, intrinsics = cameras.cam_from_world.double(), cameras.intrinsics.double()
    relative = frames[to] @ torch.linalg.inv(frames[start])
    rotation = intrinsics[to] @ relative[:, :3, :3] @ torch.linalg.inv(intrinsics[start])
    return rotation, (intrinsics[to] @ relative[:, :3, 3:])[..., 0]


def pair(level: MatchingLevel, view: int, sources: Int[Tensor, " source"]) -> Pairing:
    """Prepare the lookup of a view's pixels in others."""
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


# How windows are compared; choices.
RADIUS = 2  # they are squares of twice this and 1 pixels
_LIKENESS = 0.2  # difference of tone to the centre at which a pixel's weight has fallen to 0.6
_CONTRAST = 0.005  # standard deviation of the tone in a window below which its correlation fades
_BEST = 3  # sources that count: the best ones of each pixel


class Matcher:
    """Normalized cross-correlation of a view's windows with its sources', through any field.

    Source: Yoon & Kweon, Adaptive support-weight approach, PAMI 28(4), 2006, for the weights;
    Schönberger et al., Pixelwise view selection, ECCV 2016, for correlation with them.
    """

    def __init__(self, level: MatchingLevel, pairing: Pairing) -> None:
        tone = level.tone[pairing.view].detach().float()
        here = level.usable[pairing.view]
        around = torch.stack(shifted(tone, RADIUS, "replicate"))
        along = torch.exp(-(torch.arange(-RADIUS, RADIUS + 1) / RADIUS).square() / 2)
        spatial = (along[:, None] * along).reshape(-1, 1, 1).to(tone)
        weight = spatial * torch.exp(-((around - tone) / _LIKENESS).square() / 2)
        weight *= torch.stack(shifted(here.to(tone), RADIUS, "replicate"))
        weight /= weight.sum(dim=0).clamp_min(1e-12)
        # Around the mean, so that no difference of large numbers is left for single precision.
        around -= (weight * around).sum(dim=0)
        deviation = weight * around
        power = (deviation * around).sum(dim=0)
        of_sources = pairing.ray, pairing.shift, level.tone[pairing.sources]
        self._ray, self._shift, self._tone = (as_array(one, torch.float32) for one in of_sources)
        self._usable, self._here = as_array(level.usable[pairing.sources]), as_array(here)
        self._weight, self._deviation, self._power = map(as_array, (weight, deviation, power))

    def scores(self, field: Map, offsets: Sequence[float]) -> Float[Tensor, "offset height width"]:
        """Score a field of inverse depths moved by each of some offsets.

        The score is the mean correlation of the best sources, 0 where none sees the pixel:
        computed on the CPU in single precision, a constant to autograd.
        """
        from pimper_torch.ground.kernels.window_scores import window_scores

        found = torch.empty(len(offsets), *field.shape)
        window_scores(
            as_array(field, torch.float32),
            np.array(offsets, dtype=np.float32),
            self._ray,
            self._shift,
            self._tone,
            self._usable,
            self._weight,
            self._deviation,
            self._power,
            self._here,
            _CONTRAST**2,
            _BEST,
            found.numpy(),
        )
        return found.to(field)


def shifted(values: Map, radius: int, padding: Literal["replicate", "constant"]) -> list[Map]:
    """Return a map for each pixel of a window: the values shifted by its offset."""
    height, width = values.shape
    wide = pad(values[None, None], (radius,) * 4, mode=padding)[0, 0]
    side = range(2 * radius + 1)
    return [wide[row : row + height, column : column + width] for row in side for column in side]
