"""Conventions of depth maps, determined by the cloud: inverse or not, axis or ray, gauge.

A reading relates values ``d`` of a map to the depth of observed points: ``t = a d + b`` with ``a``
above 0, where ``t`` is depth along the axis or the ray, or its inverse.
"""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.priors.at_points import AtPoints, at_points, exif_errors, means_by, reoriented
from pimper_torch.priors.choice import better_change, clearly_better, doubt
from pimper_torch.records import DepthPrior, SparseScene
from pimper_torch.records.shapes import Scalar
from pimper_torch.runtime.errors import InputError, caution, some

Along = Literal["axis", "ray"]
Gauge = Literal["scene", "scale", "affine"]
_READINGS: dict[tuple[bool, Along], str] = {
    (False, "axis"): "depth along the camera's axis",
    (False, "ray"): "depth along the ray",
    (True, "axis"): "inverse depth (disparity) along the camera's axis",
    (True, "ray"): "inverse depth (disparity) along the ray",
}
_NAMES = tuple(_READINGS)
_GAUGES: dict[Gauge, str] = {
    "scene": "in the scene's unit",
    "scale": "up to a factor per map",
    "affine": "up to a factor and an offset per map",
}
_OURS = (False, "axis", "scene")
# Choices: least number of points for a line fit; reweighting steps; least factor between median
# errors that refutes a stated gauge; relative depth of a relief that is too flat for networks; best
# relative accuracy of clouds.
_MIN_POINTS, _STEPS, _WORSE, _FLAT, _CLOUD_ERROR = 8, 20, 2.0, 0.03, 3e-4


def resolve_depth_conventions(prior: DepthPrior, scene: SparseScene) -> DepthPrior:
    """Resolve the conventions of depth, and convert it to scene units along the camera's axis.

    If they are not stated they are determined, with a warning that states them: whether depth is
    inverse, along the axis unless along the ray fits far better, and the simplest gauge that fits.
    Factors and offsets are fitted to the cloud, map by map; standard errors are at least a map's
    error there. A map with too few points is excluded. Maps with stated conventions that require
    gradients are used as stated, with a warning for what is an error otherwise, unless there are
    too few points.

    Args:
        prior: Of undistorted photographs. Depth in scene units along the axis is not changed.

    Raises:
        InputError: A reading fits far better than the stated one, maps fit far better mirrored or
            reoriented by EXIF, none fits better than constant depth, or the cloud does not decide.
    """
    where = f"The depth of {len(prior.names)} photographs ({some(prior.names, most=1)})"
    lines, errors, observed = _fit_readings(prior.detach(), scene)
    gauges, enough = tuple(_GAUGES), errors.shape[-1] >= _MIN_POINTS
    medians = errors.median(dim=-1).values if enough else errors.new_zeros(len(_NAMES) + 1, 1)
    size = medians[:, -1].min().clamp_min(_CLOUD_ERROR)
    scores = means_by(size / (size + errors), observed.point)
    best = int(medians[:-1, -1].argmin())
    if not enough and (prior.inverse, prior.along, prior.gauge) == _OURS:
        return prior
    trained = prior.depth.requires_grad and prior.inverse is not None
    if change := _better_orientation(prior.detach(), scene, size):
        doubt(f"{where} is {change}, as the cloud shows. Turn it like the photographs.", trained)
    informative = enough and clearly_better(scores[best, -1], scores[-1, -1])
    if medians[-1, -1] > _FLAT and not informative:
        doubt(
            f"{where} fits the point cloud no better than constant depth, as depth or as inverse "
            "depth. Photographs and maps may be mixed up, or maps may have a different size.",
            trained,
        )
    if not enough or (prior.inverse is None and not informative):
        raise InputError(
            f"{where}: too few points of the cloud determine its meaning; needed: {_MIN_POINTS} in "
            "each map, at several depths. State `inverse` and `gauge`, or give it in scene units."
        )
    if prior.inverse is not None:
        stated, gauge = _NAMES.index((prior.inverse, prior.along)), gauges.index(prior.gauge)
        if informative:
            _doubt_contradicted(where, stated, gauge, best, medians, scores, trained)
        best = stated
    else:
        best, gauge = _simplest(where, best, medians, scores)
    inverse, along = _NAMES[best]
    if (inverse, along, gauges[gauge]) == _OURS:
        return prior.replace(inverse=inverse, along=along, gauge=gauges[gauge])
    deviation, maps = lines.new_zeros(len(prior.names)), observed.index[:, 0]
    for index in torch.unique(maps).tolist():
        deviation[index] = 1.4826 * errors[best, gauge, maps == index].median()  # of Gaussians
    return _to_scene_depth(prior, scene, along, inverse, lines[best, gauge], deviation)


def _simplest(where: str, best: int, medians: Tensor, scores: Tensor) -> tuple[int, int]:
    """Return reading and gauge: along the axis and the simplest ones unless others fit far better.

    A warning states them.
    """
    on_axis, gauges = _NAMES.index((_NAMES[best][0], "axis")), tuple(_GAUGES)
    if not clearly_better(scores[best, -1], scores[on_axis, -1]):
        best = on_axis
    gauge = [clearly_better(scores[best, -1], row) for row in scores[best]].index(False)
    caution(
        f"{where} is interpreted as {_READINGS[_NAMES[best]]} {_GAUGES[gauges[gauge]]}, which "
        f"fits the point cloud best: its median error at {scores.shape[-1]} points is "
        f"{medians[best, gauge]:.1%}. If this is wrong, state `inverse`, `along` and `gauge`.",
        stacklevel=5,
    )
    return best, gauge


def _doubt_contradicted(
    where: str, stated: int, gauge: int, best: int, medians: Tensor, scores: Tensor, trained: bool
) -> None:
    """Doubt the stated reading and gauge if different ones fit far better."""
    if clearly_better(scores[best, -1], scores[stated, -1]):
        doubt(
            f"{where} is {_READINGS[_NAMES[best]]}, given as {_READINGS[_NAMES[stated]]} (median "
            f"errors at the cloud: {medians[best, -1]:.1%}, {medians[stated, -1]:.1%}). State the "
            "first.",
            trained,
        )
    worse = medians[stated, gauge] > _WORSE * medians[stated, -1]
    if worse and clearly_better(scores[stated, -1], scores[stated, gauge]):
        doubt(
            f"{where} is not depth {list(_GAUGES.values())[gauge]}: its median error at the cloud "
            f"is {medians[stated, gauge]:.1%}, and {medians[stated, -1]:.1%} {_GAUGES['affine']} "
            "(`gauge` affine).",
            trained,
        )


def _ray_lengths(pixels: Tensor, scene: SparseScene, views: Tensor) -> Tensor:
    """Return the lengths of rays through pixels ``view pixel 2`` to a depth of 1."""
    poses, intrinsics = scene.cameras.cam_from_world[views], scene.cameras.intrinsics[views]
    return rays_through(pixels, poses.to(pixels), intrinsics.to(pixels)).norm(dim=-1)


def _to_scene_depth(
    prior: DepthPrior, scene: SparseScene, along: Along, inverse: bool, lines: Tensor, least: Tensor
) -> DepthPrior:
    """Convert values to depth along the camera's axis in scene units; differentiable in them.

    Args:
        lines: Factor and offset of each map; NaN where too few points determine them.
        least: Least relative standard error of each map: its error at the points.
    """
    terms = torch.cat([lines.nan_to_num(0), least[:, None]], dim=1).to(prior.depth)
    slope, offset, least = terms.mT[..., None, None]
    fitted = slope * prior.depth + offset
    valid = prior.variance.isfinite() & (fitted > 0)
    fitted = torch.where(valid, fitted, 1)
    relative = slope * torch.where(valid, prior.variance, 1).sqrt() / fitted
    depth = 1 / fitted if inverse else fitted
    if along == "ray":
        views = torch.tensor([scene.views.names.index(name) for name in prior.names])
        zoom = (scene.cameras.sizes_px[views] / prior.sizes_px)[:, None, None]
        height, width = depth.shape[1:]
        pixels = pixel_centers(width, height, like=depth) * zoom.to(depth)
        depth = depth / _ray_lengths(pixels.flatten(1, 2), scene, views).view_as(depth)
    variance = (depth * torch.maximum(relative, least)).square()
    return prior.replace(
        depth=torch.where(valid, depth, 0),
        variance=torch.where(valid, variance, torch.inf),
        along="axis",
        inverse=False,
        gauge="scene",
    )


@torch.no_grad()
def _fit_readings(
    prior: DepthPrior, scene: SparseScene
) -> tuple[Float[Tensor, "reading gauge map 2"], Tensor, AtPoints]:
    """Fit all readings, and last constant depth, to the cloud in every gauge.

    Returns:
        Factor and offset of each map, NaN where too few points determine them; relative errors,
        ``reading gauge observation``; and the observations.
    """
    observed = at_points(prior, prior.variance.isfinite(), scene)
    count = torch.bincount(observed.index[:, 0], minlength=len(prior.names))
    observed = observed.take(count[observed.index[:, 0]] >= _MIN_POINTS)
    maps = observed.index[:, 0]
    lengths = _ray_lengths(observed.pixels[:, None], scene, observed.view)[:, 0].double()
    values, axis = prior.depth[observed.index.unbind(dim=-1)].double(), observed.depth.double()
    truths = [axis, axis * lengths, 1 / axis, 1 / (axis * lengths)]  # as in _READINGS
    pairs = [*((values, truth) for truth in truths), (torch.zeros_like(values), axis)]
    lines = values.new_full((len(pairs), len(_GAUGES), len(prior.names), 2), torch.nan)
    lines[:, 0] = lines.new_tensor([1.0, 0.0])
    for reading, pair in enumerate(pairs):
        for gauge, offset in ((1, False), (2, True)):
            lines[reading, gauge] = _fit_lines(*pair, maps, len(prior.names), offset)
    line = lines[:, :, maps]
    values, truth = (torch.stack(rows)[:, None] for rows in zip(*pairs, strict=True))
    return lines, (line[..., 0] * values + line[..., 1] - truth).abs() / truth, observed


@torch.no_grad()
def _better_orientation(prior: DepthPrior, scene: SparseScene, size: Scalar) -> str:
    """Return the name of the orientation error of maps, up to factor and offset, else "".

    Args:
        size: Relative error with a score of one half.
    """
    observed = at_points(prior, torch.ones_like(prior.depth, dtype=torch.bool), scene)
    maps, axis = observed.index[:, 0], observed.depth.double()

    def scores_of(tags: Int[Tensor, " map"]) -> Float[Tensor, "reading point"]:
        index = reoriented(observed.index, prior, tags).unbind(dim=-1)
        values, valid = prior.depth[index].double(), prior.variance[index].isfinite()
        scores, count = [], len(prior.names)
        for truth in (axis, 1 / axis):
            line = _fit_lines(values[valid], truth[valid], maps[valid], count, True)[maps]
            error = (line[:, 0] * values + line[:, 1] - truth).abs() / truth
            scores.append(torch.where(valid, size / (size + error), 0).nan_to_num(0))
        return means_by(torch.stack(scores), observed.point)

    unchanged = scores_of(torch.ones(len(prior.names), dtype=torch.long))
    changes = [(name, scores_of(tags)) for name, tags in exif_errors(prior, scene)]
    return better_change(unchanged[unchanged.mean(dim=1).argmax()], changes)


def _fit_lines(
    values: Float[Tensor, " observation"],
    truth: Float[Tensor, " observation"],
    maps: Int[Tensor, " observation"],
    count: int,
    offset: bool,
) -> Float[Tensor, "map 2"]:
    """Fit ``a values + b``, ``a`` at least 0, to each of ``count`` maps by least absolute errors.

    Returns:
        Factor and offset of each map; NaN where too few points determine them.
    """
    lines = values.new_full((count, 2), torch.nan)
    for index in (torch.bincount(maps) >= _MIN_POINTS).nonzero()[:, 0].tolist():
        x, y = values[maps == index], truth[maps == index]
        weight = torch.ones_like(y)
        for _ in range(_STEPS):
            weight = weight / weight.sum()
            means = [(weight * side).sum() * offset for side in (x, y)]
            dx, dy = x - means[0], y - means[1]
            squares = (weight * dx.square()).sum().clamp_min(1e-300)
            slope = ((weight * dx * dy).sum() / squares).clamp_min(0)
            error = (dy - slope * dx).abs()
            least = 1e-3 * float(error.median()) + 1e-12 * float(y.mean())
            weight = 1 / error.clamp_min(least)
        lines[index] = torch.stack([slope, means[1] - slope * means[0]])
    return lines
