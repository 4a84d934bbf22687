"""How well views match through a surface, whatever their light: correlation of windows.

A surface is a field of inverse depths over a view. Every source view is looked up once
through the field, and windows are compared in what comes back: they are slanted and bent as
the field is, at the price of one sample a pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, pad

from pimper_torch.geometry.pixels import grid_from_pixels, pixel_centers, scale_intrinsics
from pimper_torch.kernels.switch import compiled_for
from pimper_torch.records import Cameras, Record, SparseScene

# Added to radiance over its bright level before the root: without it, the noise of black
# pixels would be stretched without limit.
_PEDESTAL = 0.01

# Of all pixels' radiance, the quantile that counts as bright: above it lie highlights.
_BRIGHT = 0.98


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Level(Record):
    """All photographs at one resolution.

    Attributes:
        tone: Root of gray radiance, so that noise is about the same everywhere; about 1 at
            the photographs' bright level.
        usable: False outside photographs and masks.
        cameras: At this resolution.
    """

    tone: Float[Tensor, "view height width"]
    usable: Bool[Tensor, "view height width"]
    cameras: Cameras


def level_of(scene: SparseScene, factor: int) -> Level:
    """Reduce the photographs by a whole factor; rests at the right and the bottom fall away."""
    views, cameras = scene.views, scene.cameras
    usable = views.inside if views.masks is None else views.inside & views.masks
    gray = torch.stack(
        [
            avg_pool2d(image.mean(dim=0, keepdim=True).nan_to_num(0, 0, 0), factor)[0]
            for image in views.images
        ]
    ).clamp_min(0)
    # All of a reduced pixel has to be usable: the smallest value is that of the pool's.
    usable = torch.stack([avg_pool2d(one[None].to(gray), factor)[0] > 1 - 1e-4 for one in usable])
    shown = gray[usable] if bool(usable.any()) else gray.reshape(-1)
    bright = _quantile(shown, _BRIGHT).clamp_min(torch.finfo(gray.dtype).tiny)
    return Level(
        tone=(gray / bright + _PEDESTAL).sqrt(),
        usable=usable,
        cameras=Cameras(
            intrinsics=scale_intrinsics(cameras.intrinsics, 1 / factor, 1 / factor),
            cam_from_world=cameras.cam_from_world,
            sizes_px=cameras.sizes_px // factor,
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Pairing(Record):
    r"""One view and those it is matched with.

    A pixel with inverse depth q is seen by source s at the pixel that
    :math:`A_s (u, v, 1)^T + q \, b_s` is the homogeneous form of.

    Attributes:
        view: The view.
        sources: Those it is matched with.
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
        """Give each pixel's place in the sources, and its depth there over its depth here."""
        at = self.ray + self.shift.reshape(-1, 3, *(1,) * inverse_depth.dim()) * inverse_depth
        ratio = at[:, 2]
        return at[:, :2] / ratio.clamp_min(1e-6)[:, None], ratio


def pair(level: Level, view: int, sources: Int[Tensor, " source"]) -> Pairing:
    """Prepare the lookup of a view's pixels in others."""
    cameras = level.cameras
    height, width = level.tone.shape[-2:]
    frames, intrinsics = cameras.cam_from_world.double(), cameras.intrinsics.double()
    relative = frames[sources] @ torch.linalg.inv(frames[view])
    rotation = intrinsics[sources] @ relative[:, :3, :3] @ torch.linalg.inv(intrinsics[view])
    pixels = pixel_centers(width, height, like=rotation)
    u, v = pixels[0, :, 0], pixels[:, 0, 1]
    across, down = rotation[:, :, :1] * u, rotation[:, :, 1:2] * v + rotation[:, :, 2:]
    return Pairing(
        view=view,
        sources=sources,
        ray=(down[..., None] + across[:, :, None]).to(level.tone),
        shift=(intrinsics[sources] @ relative[:, :3, 3:])[..., 0].to(level.tone),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Windows:
    """What is compared.

    Attributes:
        radius: Windows are squares of ``2 radius + 1`` pixels.
        likeness: Difference of tone to the centre of the window at which a pixel's weight has
            fallen to 0.6: what looks different may well lie at another depth.
        contrast: Standard deviation of the tone in a window below which it says little.
        best: Sources that are believed: the best ones of each pixel.
    """

    radius: int
    likeness: float
    contrast: float
    best: int


class Matcher:
    """A view's windows, prepared to be compared through many fields.

    Source: Yoon & Kweon, Adaptive support-weight approach, PAMI 28(4), 2006, for the weights;
    Schönberger et al., Pixelwise view selection, ECCV 2016, for correlation with them.
    """

    def __init__(self, level: Level, pairing: Pairing, windows: Windows) -> None:
        self._pairing, self._windows = pairing, windows
        self._sources = level.tone[pairing.sources, None]
        self._usable = level.usable[pairing.sources, None].to(self._sources)
        self._here = level.usable[pairing.view]
        tone = level.tone[pairing.view]
        self._compiled = tone.dtype == torch.float32 and compiled_for(tone)
        if self._compiled:
            self._weigh(tone)
            return
        around = torch.stack(_shifted(tone, windows.radius))
        weight = _spatial(windows.radius).to(tone)[:, None, None] * torch.exp(
            -((around - tone) / windows.likeness).square() / 2
        )
        weight = weight * torch.stack(_shifted(self._here.to(tone), windows.radius))
        self._weight = weight / weight.sum(dim=0).clamp_min(1e-12)
        self._mean = (self._weight * around).sum(dim=0)
        # Around the mean, so that no difference of large numbers is left for single precision.
        self._deviation = self._weight * (around - self._mean)
        self._power = (self._deviation * (around - self._mean)).sum(dim=0)

    def _weigh(self, tone: Float[Tensor, "height width"]) -> None:
        from pimper_torch.kernels.windows import window_weights

        radius = self._windows.radius
        self._power = torch.empty_like(tone)
        self._weight = tone.new_empty((2 * radius + 1) ** 2, *tone.shape)
        self._deviation = torch.empty_like(self._weight)
        window_weights(
            tone.contiguous().numpy(),
            self._here.contiguous().numpy(),
            _spatial(radius).double().numpy(),
            self._windows.likeness,
            self._weight.numpy(),
            self._deviation.numpy(),
            self._power.numpy(),
        )

    def scores(
        self, field: Float[Tensor, "height width"], offsets: Sequence[float]
    ) -> Float[Tensor, "offset height width"]:
        """Give the score of a field of inverse depths moved by each of some offsets."""
        if not self._compiled:
            smallest = torch.finfo(field.dtype).tiny
            return torch.stack([self.score((field + one).clamp_min(smallest)) for one in offsets])
        from pimper_torch.kernels.windows import window_scores

        found = field.new_empty(len(offsets), *field.shape)
        window_scores(
            field.contiguous().numpy(),
            field.new_tensor(offsets).numpy(),
            self._pairing.ray.numpy(),
            self._pairing.shift.numpy(),
            self._sources[:, 0].numpy(),
            (self._usable[:, 0] > 0).numpy(),
            self._weight.numpy(),
            self._deviation.numpy(),
            self._power.numpy(),
            self._here.numpy(),
            self._windows.contrast**2,
            self._windows.best,
            found.numpy(),
        )
        return found

    def score(self, inverse_depth: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
        """Give the mean correlation of the best sources, 0 where none sees the pixel."""
        height, width = inverse_depth.shape
        place, ratio = self._pairing.look(inverse_depth)
        grid = grid_from_pixels(place.movedim(1, -1), width, height)
        seen = grid_sample(self._sources, grid, padding_mode="border", align_corners=False)[:, 0]
        there = (grid_sample(self._usable, grid, mode="nearest", align_corners=False)[:, 0] > 0) & (
            ratio > 0
        )
        correlation = torch.stack([self._correlation(one) for one in seen])
        correlation = torch.where(there & self._here, correlation, 0)
        return mean_of_largest(correlation, self._windows.best)

    def _correlation(self, seen: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
        radius, floor = self._windows.radius, self._windows.contrast**2
        mean, square, both = (torch.zeros_like(seen) for _ in range(3))
        shifted = zip(_shifted(seen, radius), _shifted(seen.square(), radius), strict=True)
        for index, (value, power) in enumerate(shifted):
            mean.addcmul_(self._weight[index], value)
            square.addcmul_(self._weight[index], power)
            both.addcmul_(self._deviation[index], value)
        spread = (square - mean.square()).clamp_min(0)
        return both / ((spread + floor) * (self._power + floor)).sqrt()


def _shifted(
    values: Float[Tensor, "height width"], radius: int
) -> list[Float[Tensor, "height width"]]:
    """Give every pixel's neighbours, one map a place in the window; borders are continued."""
    height, width = values.shape
    wide = pad(values[None, None], (radius, radius, radius, radius), mode="replicate")[0, 0]
    side = range(2 * radius + 1)
    return [wide[row : row + height, column : column + width] for row in side for column in side]


def _spatial(radius: int) -> Float[Tensor, " place"]:
    """Give a bell over the window that has fallen to 0.6 at its radius."""
    along = torch.exp(-(torch.arange(-radius, radius + 1) / radius).square() / 2)
    return (along[:, None] * along).reshape(-1)


def mean_of_largest(
    values: Float[Tensor, "source height width"], count: int
) -> Float[Tensor, "height width"]:
    """Average the largest values over the first axis: bubbles, for few of them beat a sort."""
    rest = list(values.unbind(dim=0))
    count = min(count, len(rest))
    total = torch.zeros_like(rest[0])
    for first in range(count):
        for here in range(len(rest) - 1, first, -1):
            above, below = rest[here - 1], rest[here]
            rest[here - 1], rest[here] = torch.maximum(above, below), torch.minimum(above, below)
        total = total + rest[first]
    return total / count


def _quantile(values: Float[Tensor, " value"], fraction: float) -> Float[Tensor, ""]:
    rank = min(len(values), int(fraction * len(values)) + 1)
    return values.kthvalue(rank).values
