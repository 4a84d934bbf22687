"""The meaning of depth maps, by the cloud: depth or one over it, along which way, up to what.

A reading relates values ``d`` of a map to depth ``t`` of the points that the view observes:
``t = a d + b`` with ``a`` above 0, where ``t`` is depth, distance, or one over either.
"""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.ground.geometry.pixels import pixel_centers
from pimper_torch.ground.geometry.projection import rays_through
from pimper_torch.ground.shapes import Scalar
from pimper_torch.priors.at_points import AtPoints, at_points, layouts, means_by, turned
from pimper_torch.priors.choice import better_otherwise, surely_better
from pimper_torch.records import DepthPrior, SparseScene
from pimper_torch.runtime.errors import InputError, caution, some

Along = Literal["axis", "ray"]
Gauge = Literal["scene", "scale", "affine"]
_READINGS: dict[tuple[bool, Along], str] = {
    (False, "axis"): "depth along the camera's axis",
    (False, "ray"): "depth along the ray",
    (True, "axis"): "one over depth (disparity) along the camera's axis",
    (True, "ray"): "one over depth (disparity) along the ray",
}
_GAUGES: dict[Gauge, str] = {
    "scene": "in the scene's unit",
    "scale": "up to a factor a map",
    "affine": "up to a factor and an offset a map",
}
_OURS = (False, "axis", "scene")
# Choices: points of a map that a line is fitted to at least; steps of reweighting; by how much the
# median error must grow for a stated gauge to be wrong; relative depth of a relief that estimators
# are too coarse for; relative depth that clouds are good to at best.
_FEWEST, _STEPS, _WORSE, _FLAT, _ROUGH = 8, 20, 2.0, 0.03, 3e-4


def resolve_depth_conventions(prior: DepthPrior, scene: SparseScene) -> DepthPrior:
    """Decide the meaning of depth, and convert it to scene units along the camera's axis.

    If it is left open it is found, and a warning states it: whether it is one over depth, along the
    axis unless along the ray fits far better, and the simplest gauge that fits. Factors and offsets
    are those that fit the cloud, map by map; standard errors are at least a map's error there. A
    map that shows too few points is left out.

    Args:
        prior: Of undistorted photographs. Depth in scene units along the axis is kept as it is.

    Raises:
        InputError: A reading fits far better than the stated one, maps fit far better mirrored or
            as EXIF turns them, none is better than no depth at all, or the cloud decides nothing.
    """
    where = f"The depth of {len(prior.names)} photographs ({some(prior.names, most=1)})"
    lines, errors, seen = _compared(prior.detach(), scene)
    ways, gauges = tuple(_READINGS), tuple(_GAUGES)
    told = errors.shape[-1] >= _FEWEST
    medians = errors.median(dim=-1).values if told else errors.new_zeros(len(ways) + 1, 1)
    size = medians[:, -1].min().clamp_min(_ROUGH)
    worth = means_by(size / (size + errors), seen.point)
    best = int(medians[:-1, -1].argmin())

    def at(reading: int, gauge: int = -1) -> str:
        return f"{float(medians[reading, gauge]):.1%}"

    if not told and (prior.inverse, prior.along, prior.gauge) == _OURS:
        return prior
    if what := _better_turned(prior.detach(), scene, size):
        raise InputError(f"{where} is {what}: the cloud shows it. Turn maps like the photographs.")
    helps = told and surely_better(worth[best, -1], worth[-1, -1])
    if medians[-1, -1] > _FLAT and not helps:
        raise InputError(
            f"{where} fits the cloud no better than a plane across the view, as depth or as one "
            "over depth. Photographs and maps may be mixed up, or maps be of another size."
        )
    if not told or (prior.inverse is None and not helps):
        raise InputError(
            f"{where}: too few points of the cloud show its meaning; needed: {_FEWEST} in each "
            "map, at several depths. State whether it is one over depth (`inverse`), and its "
            "`gauge`, or give it in scene units."
        )
    if prior.inverse is not None:
        stated, gauge = ways.index((prior.inverse, prior.along)), gauges.index(prior.gauge)
        if helps and surely_better(worth[best, -1], worth[stated, -1]):
            raise InputError(
                f"{where} is {_READINGS[ways[best]]}, given as {_READINGS[ways[stated]]}: the "
                f"cloud shows it (median error {at(best)} against {at(stated)}). State the first."
            )
        worse = medians[stated, gauge] > _WORSE * medians[stated, -1]
        if helps and worse and surely_better(worth[stated, -1], worth[stated, gauge]):
            raise InputError(
                f"{where} is not depth {_GAUGES[prior.gauge]}: its median error at the cloud is "
                f"{at(stated, gauge)}, and {at(stated)} {_GAUGES['affine']} (`gauge` affine)."
            )
        best = stated
    else:
        plain = ways.index((ways[best][0], "axis"))
        if not surely_better(worth[best, -1], worth[plain, -1]):
            best = plain
        gauge = [surely_better(worth[best, -1], one) for one in worth[best]].index(False)
        caution(
            f"{where} is taken to be {_READINGS[ways[best]]} {_GAUGES[gauges[gauge]]}, as the "
            f"cloud shows: its median error at {errors.shape[-1]} observations is "
            f"{at(best, gauge)}. `inverse`, `along` and `gauge` state it.",
            stacklevel=4,
        )
    inverse, along = ways[best]
    if (inverse, along, gauges[gauge]) == _OURS:
        return prior.replace(inverse=inverse, along=along, gauge=gauges[gauge])
    off = lines.new_zeros(len(prior.names))
    for one in torch.unique(seen.place[:, 0]).tolist():
        off[one] = 1.4826 * errors[best, gauge, seen.place[:, 0] == one].median()  # of Gaussians
    return _in_scene(prior, scene, along, inverse, lines[best, gauge], off)


def _lengths(pixels: Tensor, scene: SparseScene, views: Tensor) -> Tensor:
    """Return how long rays through pixels ``view pixel 2`` are for a depth of 1."""
    poses, intrinsics = scene.cameras.cam_from_world[views], scene.cameras.intrinsics[views]
    return rays_through(pixels, poses.to(pixels), intrinsics.to(pixels)).norm(dim=-1)


def _in_scene(
    prior: DepthPrior, scene: SparseScene, along: Along, inverse: bool, lines: Tensor, off: Tensor
) -> DepthPrior:
    """Convert values to depth along the camera's axis in scene units; differentiable in them.

    Args:
        lines: Factor and offset of each map; NaN where too few points show them.
        off: Relative error of each map at the points: the least standard error.
    """
    parts = torch.cat([lines.nan_to_num(0), off[:, None]], dim=1).to(prior.depth)
    slope, offset, off = parts.mT[..., None, None]
    truth = slope * prior.depth + offset
    known = prior.variance.isfinite() & (truth > 0)
    truth = torch.where(known, truth, 1)
    relative = slope * torch.where(known, prior.variance, 1).sqrt() / truth
    depth = 1 / truth if inverse else truth
    if along == "ray":
        views = torch.tensor([scene.views.names.index(name) for name in prior.names])
        zoom = (scene.cameras.sizes_px[views] / prior.sizes_px)[:, None, None]
        height, width = depth.shape[1:]
        places = pixel_centers(width, height, like=depth) * zoom.to(depth)
        depth = depth / _lengths(places.flatten(1, 2), scene, views).view_as(depth)
    variance = (depth * torch.maximum(relative, off)).square()
    return prior.replace(
        depth=torch.where(known, depth, 0),
        variance=torch.where(known, variance, torch.inf),
        along="axis",
        inverse=False,
        gauge="scene",
    )


@torch.no_grad()
def _compared(
    prior: DepthPrior, scene: SparseScene
) -> tuple[Float[Tensor, "reading gauge map 2"], Tensor, AtPoints]:
    """Fit all readings, and last a plane across the view, to the cloud in every gauge.

    Returns:
        Factor and offset of each map, NaN where too few points show them; relative errors,
        ``reading gauge observation``; and the observations.
    """
    seen = at_points(prior, prior.variance.isfinite(), scene)
    count = torch.bincount(seen.place[:, 0], minlength=len(prior.names))
    seen = seen.take(count[seen.place[:, 0]] >= _FEWEST)
    lengths = _lengths(seen.pixels[:, None], scene, seen.view)[:, 0].double()
    values, axis = prior.depth[seen.place.unbind(dim=-1)].double(), seen.depth.double()
    truths = [axis, axis * lengths, 1 / axis, 1 / (axis * lengths)]  # as in _READINGS
    pairs = [*((values, truth) for truth in truths), (torch.zeros_like(values), axis)]
    lines = values.new_full((len(pairs), len(_GAUGES), len(prior.names), 2), torch.nan)
    lines[:, 0] = lines.new_tensor([1.0, 0.0])
    for reading, pair in enumerate(pairs):
        for gauge, offset in ((1, False), (2, True)):
            lines[reading, gauge] = _lines(*pair, seen.place[:, 0], len(prior.names), offset)
    own = lines[:, :, seen.place[:, 0]]
    given, truth = (torch.stack(part)[:, None] for part in zip(*pairs, strict=True))
    return lines, (own[..., 0] * given + own[..., 1] - truth).abs() / truth, seen


@torch.no_grad()
def _better_turned(prior: DepthPrior, scene: SparseScene, size: Scalar) -> str:
    """Name the turn with which maps surely fit the cloud better, up to factor and offset.

    Args:
        size: Relative error that scores a half.
    """
    seen = at_points(prior, torch.ones_like(prior.depth, dtype=torch.bool), scene)
    maps, axis = seen.place[:, 0], seen.depth.double()

    def worth(tags: Int[Tensor, " map"]) -> Float[Tensor, "reading point"]:
        place = turned(seen.place, prior, tags).unbind(dim=-1)
        values, known = prior.depth[place].double(), prior.variance[place].isfinite()
        scores = []
        for truth in (axis, 1 / axis):
            lines = _lines(values[known], truth[known], maps[known], len(prior.names), True)[maps]
            error = (lines[:, 0] * values + lines[:, 1] - truth).abs() / truth
            scores.append(torch.where(known, size / (size + error), 0).nan_to_num(0))
        return means_by(torch.stack(scores), seen.point)

    plain = worth(torch.ones(len(prior.names), dtype=torch.long))
    turns = [(what, worth(tags)) for what, tags in layouts(prior, scene)]
    return better_otherwise(plain[plain.mean(dim=1).argmax()], turns)


def _lines(
    values: Float[Tensor, " observation"],
    truth: Float[Tensor, " observation"],
    maps: Int[Tensor, " observation"],
    count: int,
    offset: bool,
) -> Float[Tensor, "map 2"]:
    """Fit ``a values + b``, ``a`` at least 0, to each of ``count`` maps for small absolute errors.

    Returns:
        Factor and offset of each map; NaN where too few points show them.
    """
    lines = values.new_full((count, 2), torch.nan)
    for one in torch.unique(maps).tolist():
        given, wanted = values[maps == one], truth[maps == one]
        if len(given) < _FEWEST:
            continue
        weight = torch.ones_like(wanted)
        for _ in range(_STEPS):
            weight = weight / weight.sum()
            means = [(weight * each).sum() * offset for each in (given, wanted)]
            across, along = given - means[0], wanted - means[1]
            squares = (weight * across.square()).sum().clamp_min(1e-300)
            slope = ((weight * across * along).sum() / squares).clamp_min(0)
            error = (along - slope * across).abs()
            least = 1e-3 * float(error.median()) + 1e-12 * float(wanted.mean())
            weight = 1 / error.clamp_min(least)
        lines[one] = torch.stack([slope, means[1] - slope * means[0]])
    return lines
