"""Depth maps of all views from windows that match, coarse to fine."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, max_pool2d

from pimper_torch.coarse.matching import Level, Matcher, Windows, level_of, pair
from pimper_torch.coarse.neighbours import choose_sources, inverse_depths, step_for_one_pixel
from pimper_torch.config import require
from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.parallel import side_by_side
from pimper_torch.records import Record, SparseScene


@dataclass(frozen=True, slots=True, kw_only=True)
class DensifyConfig:
    """How depth maps are searched.

    Attributes:
        coarsest_px: Longer side of the photographs, about, where the whole range of depths
            is searched.
        levels: How often the resolution doubles from there, that included.
        sources: Views that a view is matched with.
        best_sources: Of these, the ones believed at a pixel.
        radius: Of the windows, pixels.
        likeness: Difference of root radiance to the centre of a window beyond which a pixel
            counts little; 1 is bright.
        contrast: Of root radiance in a window, below which it says little; 1 is bright.
        margin: Share by which the searched range of inverse depths exceeds the points'.
        max_hypotheses: Of the search of the whole range.
        min_score: Correlation that a depth needs.
        max_error_px: Reprojection error between two views' depths that agree.
        agreeing: Other views that have to agree.
    """

    coarsest_px: int = 100
    levels: int = 3
    sources: int = 5
    best_sources: int = 3
    radius: int = 2
    likeness: float = 0.2
    contrast: float = 0.005
    margin: float = 0.15
    max_hypotheses: int = 160
    min_score: float = 0.5
    max_error_px: float = 1.0
    agreeing: int = 2

    def __post_init__(self) -> None:
        require(self.coarsest_px >= 32, "coarsest_px", self.coarsest_px, "32 or more")
        require(self.levels >= 1, "levels", self.levels, "1 or more")
        require(self.sources >= 1, "sources", self.sources, "1 or more")
        fits = 1 <= self.best_sources <= self.sources
        require(fits, "best_sources", self.best_sources, f"1 to sources ({self.sources})")
        require(self.radius >= 1, "radius", self.radius, "1 or more")
        require(self.likeness > 0, "likeness", self.likeness, "above 0")
        require(self.contrast > 0, "contrast", self.contrast, "above 0")
        require(self.margin >= 0, "margin", self.margin, "0 or more")
        require(self.max_hypotheses >= 8, "max_hypotheses", self.max_hypotheses, "8 or more")
        require(0 < self.min_score < 1, "min_score", self.min_score, "in (0, 1)")
        require(self.max_error_px > 0, "max_error_px", self.max_error_px, "above 0")
        require(self.agreeing >= 1, "agreeing", self.agreeing, "1 or more")

    @property
    def windows(self) -> Windows:
        """What is compared."""
        return Windows(
            radius=self.radius,
            likeness=self.likeness,
            contrast=self.contrast,
            best=self.best_sources,
        )

    def factors(self, longest_px: int) -> tuple[int, ...]:
        """Give by how much photographs of that size are reduced, the coarsest first."""
        coarsest = max(1, round(longest_px / self.coarsest_px))
        return tuple(dict.fromkeys(max(1, coarsest >> rank) for rank in range(self.levels)))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class DepthMaps(Record):
    """Depths of all views at one resolution.

    Attributes:
        factor: Pixels of the photographs along a side of one here.
        level: The photographs at that resolution.
        inverse_depth: Of every pixel, whether it can be believed or not.
        score: Correlation of the windows.
        agreed: How many other views agree; 0 where the windows do not match.
        valid: True where enough of them do, and the windows match.
        step: Change of inverse depth that moves a pixel by one in the sources; one a view.
        sources: The views each was matched with, -1 for none.
    """

    factor: int
    level: Level
    inverse_depth: Float[Tensor, "view height width"]
    score: Float[Tensor, "view height width"]
    agreed: Int[Tensor, "view height width"]
    valid: Bool[Tensor, "view height width"]
    step: Float[Tensor, " view"]
    sources: Int[Tensor, "view source"]


def depth_maps(
    scene: SparseScene, points: Int[Tensor, " chosen"], config: DensifyConfig
) -> tuple[DepthMaps, ...]:
    """Search every view's depths: the whole range at low resolution, then near what was found.

    Args:
        scene: Photographs, cameras and cloud.
        points: Trusted ones.
        config: Settings.

    Returns:
        The maps of every resolution, the coarsest first.
    """
    maps: list[DepthMaps] = []
    for factor in config.factors(max(scene.views.images.shape[-2:])):
        level, before = level_of(scene, factor), maps[-1] if maps else None
        search = partial(_search, scene, points, level, config, before)
        found = list(side_by_side(search, range(scene.cameras.num_views)))
        maps.append(_checked(factor, level, found, config))
    return tuple(maps)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Found(Record):
    inverse_depth: Float[Tensor, "height width"]
    score: Float[Tensor, "height width"]
    step: float
    sources: Int[Tensor, " source"]


def _search(
    scene: SparseScene,
    points: Int[Tensor, " chosen"],
    level: Level,
    config: DensifyConfig,
    before: DepthMaps | None,
    view: int,
) -> _Found:
    sources = choose_sources(scene, points, view, config.sources)
    here = points[scene.observed[points, view]]
    pixels, known, within = inverse_depths(scene.points_world[here], level.cameras, view)
    pixels, known = pixels[within], known[within]
    blank = torch.zeros_like(level.tone[view])
    if len(sources) == 0 or len(known) < 3:
        return _Found(inverse_depth=blank, score=blank, step=0.0, sources=sources)
    pairing = pair(level, view, sources)
    matcher = Matcher(level, pairing, config.windows)
    step = step_for_one_pixel(pairing, pixels, known)
    if before is None:
        found, score = _whole_range(matcher, pixels, known, blank, step, config)
    else:
        field = filled(before, view)
        field = interpolate(field[None, None], blank.shape, mode="bilinear", align_corners=False)
        found, score = _near(matcher, field[0, 0], step)
    field = median3(found)
    found, score = sweep(matcher, field, [0.5 * step * rank for rank in (-2, -1, 0, 1, 2)])
    return _Found(inverse_depth=found, score=score, step=step, sources=sources)


def _whole_range(
    matcher: Matcher,
    pixels: Float[Tensor, "point 2"],
    known: Float[Tensor, " point"],
    blank: Float[Tensor, "height width"],
    step: float,
    config: DensifyConfig,
) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Search planes that face the camera, then surfaces that run as the points do."""
    low, high = torch.quantile(known.double(), known.new_tensor([0.01, 0.99]).double()).tolist()
    low, high = low - config.margin * (high - low), high + config.margin * (high - low)
    low = max(low, 0.1 * high)
    count = min(config.max_hypotheses, max(3, round((high - low) / (0.7 * step))))
    found, score = sweep(matcher, blank, np.linspace(low, high, count).tolist())
    along = spanned(pixels, known, blank)
    reach = min(10, count)
    again, better = sweep(matcher, along, [0.7 * step * rank for rank in range(-reach, reach + 1)])
    return torch.where(better > score, again, found), torch.maximum(better, score)


def _near(
    matcher: Matcher, field: Float[Tensor, "height width"], step: float
) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Search near a field, and near what lies on either side of its steps."""
    offsets = [0.8 * step * rank for rank in range(-3, 4)]
    found, score = sweep(matcher, field, offsets)
    for side in (_nearest_around(field, 2), -_nearest_around(-field, 2)):
        again, better = sweep(matcher, side, offsets[2:-2])
        found = torch.where(better > score, again, found)
        score = torch.maximum(better, score)
    return found, score


def sweep(
    matcher: Matcher, field: Float[Tensor, "height width"], offsets: Sequence[float]
) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Move a field by each of some evenly spaced offsets and keep the best at every pixel.

    Returns:
        Inverse depth between the offsets, by the parabola through the best and those beside
        it, and the best score.
    """
    smallest = torch.finfo(field.dtype).tiny
    scores = matcher.scores(field, offsets)
    score, best = scores.max(dim=0)
    before = scores.gather(0, (best - 1).clamp_min(0)[None])[0]
    after = scores.gather(0, (best + 1).clamp_max(len(offsets) - 1)[None])[0]
    bend = before + after - 2 * score
    inner = (best > 0) & (best < len(offsets) - 1) & (bend < 0)
    shift = torch.where(inner, (before - after) / (2 * torch.where(inner, bend, -1)), 0)
    spacing = offsets[1] - offsets[0] if len(offsets) > 1 else 0.0
    at = field.new_tensor(offsets)[best] + spacing * shift.clamp(-0.5, 0.5)
    return (field + at).clamp_min(smallest), score


def _checked(
    factor: int, level: Level, found: Sequence[_Found], config: DensifyConfig
) -> DepthMaps:
    inverse_depth = torch.stack([one.inverse_depth for one in found])
    score = torch.stack([one.score for one in found])
    sources = torch.full((len(found), config.sources), -1, device=score.device)
    for view, one in enumerate(found):
        sources[view, : len(one.sources)] = one.sources
    good = (score >= config.min_score) & level.usable & (inverse_depth > 0)

    def checked(view: int) -> Int[Tensor, "height width"]:
        others = found[view].sources
        return agreeing(level, inverse_depth, good, view, others, config.max_error_px)

    agreed = torch.stack(list(side_by_side(checked, range(len(found)), tracked=False)))
    return DepthMaps(
        factor=factor,
        level=level,
        inverse_depth=inverse_depth,
        score=score,
        agreed=agreed,
        valid=good & (agreed >= config.agreeing),
        step=score.new_tensor([one.step for one in found]),
        sources=sources,
    )


def agreeing(
    level: Level,
    inverse_depth: Float[Tensor, "view height width"],
    good: Bool[Tensor, "view height width"],
    view: int,
    others: Int[Tensor, " other"],
    max_error_px: float,
) -> Int[Tensor, "height width"]:
    """Count the views whose depths say the same: there and back lands on the same pixel.

    0 where the view's own depth is not good.
    """
    height, width = inverse_depth.shape[-2:]
    count = torch.zeros_like(good[view], dtype=torch.long)
    if len(others) == 0:
        return count
    chosen, known = good[view], inverse_depth[view][good[view]]
    forth = pair(level, view, others)
    place, ratio = forth.replace(ray=forth.ray[:, :, chosen]).look(known)
    grid = grid_from_pixels(place.movedim(1, -1), width, height)
    there = _looked_up(inverse_depth[others], grid, "nearest")
    fine = _looked_up(good[others].to(there), grid, "nearest") > 0.5
    expected = known / ratio.clamp_min(1e-6)
    # Depth there is compared where it is read: how far the source's own point would move
    # on this view's picture is its step in inverse depth, in pixels.
    rate = _pixels_per_inverse_depth(level, view, others, place, there)
    error = (there - expected).abs() * rate
    count[chosen] = (fine & (ratio > 0) & (error <= max_error_px)).sum(dim=0)
    return count


def _pixels_per_inverse_depth(
    level: Level,
    view: int,
    others: Int[Tensor, " other"],
    place: Float[Tensor, "other 2 place"],
    inverse_depth: Float[Tensor, "other place"],
) -> Float[Tensor, "other place"]:
    """Say how fast the points that sources see move on a view as their inverse depth changes."""
    cameras = level.cameras
    frames, intrinsics = cameras.cam_from_world.double(), cameras.intrinsics.double()
    relative = frames[view] @ torch.linalg.inv(frames[others])
    rotation = intrinsics[view] @ relative[:, :3, :3] @ torch.linalg.inv(intrinsics[others])
    shift = (intrinsics[view] @ relative[:, :3, 3:])[..., 0].to(place)[:, :, None]
    homogeneous = torch.cat([place, torch.ones_like(place[:, :1])], dim=1)
    ray = torch.einsum("oij,ojp->oip", rotation.to(place), homogeneous)
    at = ray + inverse_depth[:, None] * shift
    depth = at[:, 2:].clamp_min(1e-6)
    rate = (shift[:, :2] - at[:, :2] / depth * shift[:, 2:]) / depth
    # The norm over an inner axis takes twenty times as long.
    return torch.hypot(rate[:, 0], rate[:, 1])


def filled(maps: DepthMaps, view: int) -> Float[Tensor, "height width"]:
    """Give a view's inverse depths without holes.

    What the view itself does not know comes from what others see there, nearest first; the
    rest is spread from its neighbours.
    """
    field, known = maps.inverse_depth[view], maps.valid[view]
    sources = maps.sources[view]
    splat = torch.zeros_like(field)
    for source in sources[sources >= 0].tolist():
        splat = torch.maximum(splat, splatted(maps, source, view))
    field = torch.where(known, field, splat)
    return push_pull(field, known | (splat > 0))


def splatted(maps: DepthMaps, source: int, view: int) -> Float[Tensor, "height width"]:
    """Carry one view's valid depths to another; 0 where none falls, the nearest where many do."""
    one = torch.tensor([view], device=maps.valid.device)
    place, ratio = pair(maps.level, source, one).look(maps.inverse_depth[source])
    chosen = maps.valid[source] & (ratio[0] > 0)
    height, width = chosen.shape
    column, row = place[0][:, chosen].floor().long()
    value = (maps.inverse_depth[source] / ratio[0].clamp_min(1e-6))[chosen]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = (row * width + column)[inside]
    flat = torch.zeros(height * width, dtype=value.dtype, device=value.device)
    return flat.scatter_reduce(0, index, value[inside], "amax").reshape(height, width)


def push_pull(
    values: Float[Tensor, "height width"], known: Bool[Tensor, "height width"]
) -> Float[Tensor, "height width"]:
    """Fill holes smoothly from a pyramid of averages; known values stay.

    Source: Gortler et al., The Lumigraph, SIGGRAPH 1996, section 3.3.
    """
    weight = known.to(values)
    if bool(known.all()) or not bool(known.any()) or min(values.shape) == 1:
        return values if bool(known.any()) else torch.zeros_like(values)
    stacked = torch.stack([values * weight, weight])[None]
    total, fraction = avg_pool2d(stacked, 2, ceil_mode=True, count_include_pad=False)[0]
    below = push_pull(total / fraction.clamp_min(1e-12), fraction > 0)
    up = interpolate(below[None, None], values.shape, mode="bilinear", align_corners=False)
    return torch.where(known, values, up[0, 0])


def spanned(
    pixels: Float[Tensor, "point 2"],
    values: Float[Tensor, " point"],
    like: Float[Tensor, "height width"],
) -> Float[Tensor, "height width"]:
    """Spread values smoothly from some pixels of an image over all."""
    height, width = like.shape
    column = pixels[:, 0].long().clamp(0, width - 1)
    row = pixels[:, 1].long().clamp(0, height - 1)
    known = torch.zeros_like(like).reshape(-1)
    known = known.scatter_reduce(0, row * width + column, values.to(like), "amax")
    known = known.reshape(height, width)
    return push_pull(known, known > 0)


def median3(values: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Take the median of every pixel and its eight neighbours."""
    wide = torch.nn.functional.pad(values[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    # Columns of three sorted once, then the largest of the smallest, the median of the centre ones
    # and the smallest of the largest: their median is that of the nine.
    height, width = values.shape
    low, centre, high = _sorted3(*(wide[row : row + height] for row in range(3)))
    lows, centres, highs = (
        [one[:, column : column + width] for column in range(3)] for one in (low, centre, high)
    )
    return _sorted3(_sorted3(*lows)[2], _sorted3(*centres)[1], _sorted3(*highs)[0])[1]


def _sorted3(one: Tensor, other: Tensor, third: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    low, high = torch.minimum(one, other), torch.maximum(one, other)
    most = torch.maximum(high, third)
    rest = torch.minimum(high, third)
    return torch.minimum(low, rest), torch.maximum(low, rest), most


def _nearest_around(
    field: Float[Tensor, "height width"], radius: int
) -> Float[Tensor, "height width"]:
    return max_pool2d(field[None, None], 2 * radius + 1, 1, radius)[0, 0]


def _looked_up(
    maps: Float[Tensor, "other height width"], grid: Float[Tensor, "other place 2"], how: str
) -> Float[Tensor, "other place"]:
    return grid_sample(maps[:, None], grid[:, None], mode=how, align_corners=False)[:, 0, 0]
