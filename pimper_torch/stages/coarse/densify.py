"""Depth maps of all views by window matching, coarse to fine."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, max_pool2d, normalize

from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.geometry.projection import project
from pimper_torch.records import Record, SparseScene
from pimper_torch.records.shapes import Map, Maps, Mask, Masks, Pixels
from pimper_torch.runtime.mapped import stacked, zeros
from pimper_torch.runtime.memory import release_memory
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.coarse.window_matching import (
    Matcher,
    MatchingLevel,
    Pairing,
    level_of,
    pair,
    pixels_from_pixels,
    shifted,
)

# Approximate longer side of the photographs when the full range of depths is searched.
_COARSEST_PX = 100

# Largest number of depth hypotheses for the full range.
_MAX_HYPOTHESES = 160

# Number of views that a view is matched with. A choice.
_NUM_SOURCES = 5

# Fraction by which the full range exceeds the points' range of inverse depths on either side: the
# surface extends beyond its sparse points.
_RANGE_MARGIN = 0.15

# Best angle between rays, the top of a bell curve: below about 5 degrees depth is poorly
# determined, above about 25 windows look different.
_BEST_ANGLE_DEG = 12.0

# Requirements for a valid depth: correlation of its windows; other views that agree, and their
# reprojection error. Choices: two views seldom agree by chance; the finest step resolves a pixel.
_MIN_SCORE, _MIN_AGREEING, _MAX_ERROR_PX = 0.5, 2, 1.0

# Steps between hypotheses, in pixels of the sources: over the full range; around the coarser field;
# around the best of either. Choices: the peak of the correlation is a pixel or two wide.
_FULL_STEP, _NEAR_STEP, _LAST_STEP = 0.7, 0.8, 0.5


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class DepthMaps(Record):
    """Depth maps of all views at one resolution.

    Attributes:
        factor: Reduction of the photographs: their pixels along a side of a pixel here.
        agreed: Number of other views that agree; 0 where the windows do not match.
        valid: True where enough of them agree and the windows match.
        step: Per view, the change of inverse depth that moves a pixel by one in the sources.
        sources: Views that each view was matched with, padded with -1.
    """

    factor: int
    level: MatchingLevel
    inverse_depth: Maps
    agreed: Int[Tensor, "view height width"]
    valid: Masks
    step: Float[Tensor, " view"]
    sources: Int[Tensor, "view source"]


def factors(longest_px: int, levels: int) -> tuple[int, ...]:
    """Return the reduction factors of photographs of this size, the coarsest first."""
    coarsest = max(1, round(longest_px / _COARSEST_PX))
    return tuple(dict.fromkeys(max(1, coarsest >> rank) for rank in range(levels)))


def depth_maps(
    scene: SparseScene, points: Int[Tensor, " chosen"], levels: int
) -> tuple[DepthMaps, ...]:
    """Compute depth maps of all views: the full range at low resolution, then near the last depth.

    Args:
        levels: Number of resolutions, doubling from a longer side of about 100 pixels.

    Returns:
        The maps of every resolution, the coarsest first.

    Source: Schönberger et al., Pixelwise view selection for unstructured multi-view stereo, ECCV
    2016, for windows, sources and consistency; planes are swept instead of a random search.
    """
    maps: list[DepthMaps] = []
    chosen = [choose_sources(scene, points, view) for view in range(scene.cameras.num_views)]
    for factor in factors(max(scene.views.images.shape[-2:]), levels):
        level = level_of(scene, factor)
        search = partial(_search, scene, points, level, chosen, maps[-1] if maps else None)
        # Allocated in advance: small results between freed blocks would fragment the memory.
        fields = zeros((2, *level.tone.shape), level.tone.dtype, level.tone.device)
        steps = []
        for view, (field, score, step) in enumerate(side_by_side(search, range(len(chosen)))):
            fields[0, view], fields[1, view] = field, score
            steps.append(step)
        maps.append(_checked(factor, level, fields, steps, chosen))
        release_memory()
    return tuple(maps)


def _search(
    scene: SparseScene,
    points: Int[Tensor, " chosen"],
    level: MatchingLevel,
    chosen: Sequence[Int[Tensor, " _"]],
    before: DepthMaps | None,
    view: int,
) -> tuple[Map, Map, float]:
    """Return a view's inverse depths, their scores, and the step that moves a pixel by one."""
    sources = chosen[view]
    observed, cameras = points[scene.observed[points, view]], level.cameras
    pixels, depth = project(
        scene.points_world[observed], cameras.cam_from_world[view], cameras.intrinsics[view]
    )
    within = ((pixels > 0) & (pixels < cameras.sizes_px[view])).all(dim=1) & (depth > 0)
    pixels, values = pixels[within], 1 / depth[within]
    blank = torch.zeros_like(level.tone[view])
    if len(sources) == 0 or len(values) < 3:
        return blank, blank, 0.0
    pairing = pair(level, view, sources)
    matcher = Matcher(level, pairing)
    step = step_for_one_pixel(pairing, pixels, values)
    if before is None:
        field, _ = _full_range(matcher, pixels, values, blank, step)
    else:
        field = filled_inverse_depths(before, view)
        field = interpolate(field[None, None], blank.shape, mode="bilinear", align_corners=False)
        field, _ = _near(matcher, field[0, 0], step)
    offsets = [_LAST_STEP * step * rank for rank in (-2, -1, 0, 1, 2)]
    median = torch.stack(shifted(field, 1, "replicate")).median(dim=0).values
    return *sweep(matcher, median, offsets), step


def _full_range(
    matcher: Matcher, pixels: Pixels, values: Float[Tensor, " point"], blank: Map, step: float
) -> tuple[Map, Map]:
    """Sweep planes parallel to the image, then offsets of a smooth surface through the points."""
    low, high = torch.quantile(values.double(), values.new_tensor([0.01, 0.99]).double()).tolist()
    low, high = low - _RANGE_MARGIN * (high - low), high + _RANGE_MARGIN * (high - low)
    low = max(low, 0.1 * high)
    count = min(_MAX_HYPOTHESES, max(3, round((high - low) / (_FULL_STEP * step))))
    planes, score = sweep(matcher, blank, np.linspace(low, high, count).tolist())
    points = _splatted(pixels, values, blank)
    smooth = push_pull(points, points > 0)
    reach = min(10, count)
    offsets = [_FULL_STEP * step * rank for rank in range(-reach, reach + 1)]
    return _better(planes, score, *sweep(matcher, smooth, offsets))


def _near(matcher: Matcher, field: Map, step: float) -> tuple[Map, Map]:
    """Sweep near a field, and near the larger and smaller depths on either side of its steps."""
    offsets = [_NEAR_STEP * step * rank for rank in range(-3, 4)]
    best, score = sweep(matcher, field, offsets)
    highest, lowest = (max_pool2d(side[None, None], 5, 1, 2)[0, 0] for side in (field, -field))
    for side in (highest, -lowest):
        best, score = _better(best, score, *sweep(matcher, side, offsets[2:-2]))
    return best, score


def _better(field: Map, score: Map, other: Map, other_score: Map) -> tuple[Map, Map]:
    """Return the field of the higher score at every pixel, and that score."""
    return torch.where(other_score > score, other, field), torch.maximum(other_score, score)


def sweep(matcher: Matcher, field: Map, offsets: Sequence[float]) -> tuple[Map, Map]:
    """Return the best inverse depth at every pixel among evenly spaced offsets of a field.

    Returns:
        Inverse depth, by the parabola through the best offset and its neighbours; best score.
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
    offset = field.new_tensor(offsets)[best] + spacing * shift.clamp(-0.5, 0.5)
    return (field + offset).clamp_min(smallest), score


def _checked(
    factor: int,
    level: MatchingLevel,
    fields: Float[Tensor, "2 view height width"],
    steps: Sequence[float],
    chosen: Sequence[Int[Tensor, " _"]],
) -> DepthMaps:
    """Return depth maps; depths are valid if their windows match and other views agree."""
    inverse_depth, score = fields
    sources = torch.full((len(chosen), _NUM_SOURCES), -1, device=score.device)
    for view, views in enumerate(chosen):
        sources[view, : len(views)] = views
    good = (score >= _MIN_SCORE) & level.usable & (inverse_depth > 0)

    def counted(view: int) -> Int[Tensor, "height width"]:
        return count_agreeing(level, inverse_depth, good, view, chosen[view])

    agreed = stacked(side_by_side(counted, range(len(chosen)), tracked=False), len(chosen))
    return DepthMaps(
        factor=factor,
        level=level,
        inverse_depth=inverse_depth,
        agreed=agreed,
        valid=good & (agreed >= _MIN_AGREEING),
        step=score.new_tensor(steps),
        sources=sources,
    )


def count_agreeing(
    level: MatchingLevel, inverse_depth: Maps, good: Masks, view: int, others: Int[Tensor, " other"]
) -> Int[Tensor, "height width"]:
    """Count the other views whose depths agree: reprojection there and back ends on the same pixel.

    The count is 0 where the view's own depth is not good.
    """
    height, width = inverse_depth.shape[-2:]
    count = torch.zeros_like(good[view], dtype=torch.long)
    if len(others) == 0:
        return count
    chosen, values = good[view], inverse_depth[view][good[view]]
    pairing = pair(level, view, others)
    pixels, ratio = pairing.replace(ray=pairing.ray[:, :, chosen]).project(values)
    grid = grid_from_pixels(pixels.movedim(1, -1), width, height)
    measured = nearest_pixels(inverse_depth[others], grid)
    valid = nearest_pixels(good[others].to(measured), grid) > 0.5
    expected = values / ratio.clamp_min(1e-6)
    # Reprojection error to first order in inverse depth, without rounding to the source's pixel.
    rotation, shift = pixels_from_pixels(level.cameras, view, others)
    shift = shift.to(pixels)[:, :, None]
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[:, :1])], dim=1)
    back = torch.einsum("oij,ojp->oip", rotation.to(pixels), homogeneous)
    back = back + measured[:, None] * shift
    depth = back[:, 2:].clamp_min(1e-6)
    rate = (shift[:, :2] - back[:, :2] / depth * shift[:, 2:]) / depth
    # The norm over an inner axis takes twenty times as long.
    error = (measured - expected).abs() * torch.hypot(rate[:, 0], rate[:, 1])
    count[chosen] = (valid & (ratio > 0) & (error <= _MAX_ERROR_PX)).sum(dim=0)
    return count


def filled_inverse_depths(maps: DepthMaps, view: int) -> Map:
    """Return a view's inverse depths, filled where they are not valid.

    First by the nearest of its sources' points, then smoothly from the neighbours.
    """
    field, valid = maps.inverse_depth[view], maps.valid[view]
    sources = maps.sources[view]
    splat, index = torch.zeros_like(field), torch.tensor([view], device=field.device)
    for source in sources[sources >= 0].tolist():
        pixels, ratio = pair(maps.level, source, index).project(maps.inverse_depth[source])
        chosen = maps.valid[source] & (ratio[0] > 0)
        value = (maps.inverse_depth[source] / ratio[0].clamp_min(1e-6))[chosen]
        splat = torch.maximum(splat, _splatted(pixels[0][:, chosen].mT, value, field))
    field = torch.where(valid, field, splat)
    return push_pull(field, valid | (splat > 0))


def _splatted(pixels: Pixels, values: Float[Tensor, " point"], like: Map) -> Map:
    """Return a map of inverse depths of the points: the nearest in each pixel, 0 without any."""
    height, width = like.shape
    column, row = pixels.floor().long().unbind(dim=1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = (row * width + column)[inside]
    flat = torch.zeros_like(like).reshape(-1)
    return flat.scatter_reduce(0, index, values.to(like)[inside], "amax").reshape(height, width)


def push_pull(values: Map, valid: Mask) -> Map:
    """Return values with holes filled smoothly from a pyramid of averages; valid values stay.

    Source: Gortler et al., The Lumigraph, SIGGRAPH 1996, section 3.3.
    """
    weight = valid.to(values)
    if bool(valid.all()) or not bool(valid.any()) or min(values.shape) == 1:
        return values if bool(valid.any()) else torch.zeros_like(values)
    stacked = torch.stack([values * weight, weight])[None]
    total, fraction = avg_pool2d(stacked, 2, ceil_mode=True, count_include_pad=False)[0]
    below = push_pull(total / fraction.clamp_min(1e-12), fraction > 0)
    up = interpolate(below[None, None], values.shape, mode="bilinear", align_corners=False)
    return torch.where(valid, values, up[0, 0])


def nearest_pixels(
    maps: Float[Tensor, "other height width"], grid: Float[Tensor, "other point 2"]
) -> Float[Tensor, "other point"]:
    """Return the maps' values in the pixels that contain the grid positions."""
    return grid_sample(maps[:, None], grid[:, None], mode="nearest", align_corners=False)[:, 0, 0]


def choose_sources(
    scene: SparseScene, points: Int[Tensor, " chosen"], view: int
) -> Int[Tensor, " source"]:
    """Return the views to match a view with, by shared points and the angles at them.

    Returns:
        At most five views that share points, the best first.
    """
    observed = scene.observed[points]
    in_view = observed[:, view]
    points_world, shared = scene.points_world[points[in_view]], observed[in_view]
    rays = normalize(points_world[:, None] - scene.cameras.centers_world, dim=-1)
    angle = torch.rad2deg((rays * rays[:, view, None]).sum(dim=-1).clamp(-1, 1).acos())
    away = angle - _BEST_ANGLE_DEG
    value = torch.exp(-(away / torch.where(away < 0, 4.0, 12.0)).square() / 2)
    score = (value * shared).sum(dim=0)
    score[view] = 0
    order = score.argsort(descending=True)[:_NUM_SOURCES]
    return order[score[order] > 0]


def step_for_one_pixel(
    pairing: Pairing, pixels: Pixels, inverse_depth: Float[Tensor, " point"]
) -> float:
    """Return the change of inverse depth that moves points by one pixel in the sources.

    The median over points and sources: cameras around an object have about the same baseline.
    """
    height, width = pairing.ray.shape[-2:]
    column = pixels[:, 0].long().clamp(0, width - 1)
    row = pixels[:, 1].long().clamp(0, height - 1)
    at_points = pairing.replace(ray=pairing.ray[:, :, row, column])
    change = 0.01 * inverse_depth.median()
    before, after = (at_points.project(inverse_depth + sign * change)[0] for sign in (-1, 1))
    moved = (after - before).norm(dim=1).median()
    return float(2 * change / moved.clamp_min(1e-6))
