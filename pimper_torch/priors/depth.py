"""Whether maps hold depth or one over it, along which way, and up to what, by the cloud.

A reading says how values ``d`` of a map belong to depth ``t`` of the points that the view
observes: ``t = a d + b`` with ``a`` above 0, where ``t`` is depth, distance, or one over either.
"""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.errors import InputError, caution, some
from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.priors.at_points import at_points, means_by
from pimper_torch.records import DepthPrior, SparseScene
from pimper_torch.sfm.squares import ERRORS, standard_errors

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
# Choices: points of a map that a line is fitted to at least; steps of reweighting; by how much the
# median error must grow for a stated gauge to be wrong; relative depth of a relief that estimators
# are too coarse for.
_FEWEST, _STEPS, _WORSE, _FLAT = 8, 20, 2.0, 0.03


def settled_depth(prior: DepthPrior, scene: SparseScene) -> DepthPrior:
    """Decide what depth means.

    Where it is left open it is found, which is told in a warning: whether it is one over depth,
    along the axis unless along the ray fits far better, and the simplest gauge that fits.

    Args:
        prior: Of undistorted photographs.

    Raises:
        InputError: Another reading than the stated one fits far better, none is better than no
            depth at all, or nothing tells.
    """
    where = f"The depth of {len(prior.names)} photographs ({some(prior.names, most=1)})"
    errors, point = _errors(prior.detach(), scene)
    ways, gauges = tuple(_READINGS), tuple(_GAUGES)
    told = errors.shape[-1] >= _FEWEST
    medians = errors.median(dim=-1).values if told else errors.new_zeros(len(ways) + 1, 1)
    size = medians[:, -1].min()
    worth = means_by(size / (size + errors), point)
    best = int(medians[:-1, -1].argmin())

    def far_better(one: Tensor, other: Tensor) -> bool:
        return standard_errors(one - other) > ERRORS

    def at(reading: int, gauge: int = -1) -> str:
        return f"{float(medians[reading, gauge]):.1%}"

    if not told or not far_better(worth[best, -1], worth[-1, -1]):
        if medians[-1, -1] > _FLAT:
            raise InputError(
                f"{where} fits the cloud no better than a plane across the view, as depth or as "
                "one over depth. Photographs and maps may be mixed up, or maps be of another size."
            )
        if prior.inverse is not None:
            return prior
        raise InputError(
            f"{where}: too few points of the cloud tell what it is. State whether it is one over "
            "depth (`inverse`), and its `gauge`."
        )
    if prior.inverse is not None:
        stated, gauge = ways.index((prior.inverse, prior.along)), gauges.index(prior.gauge)
        if far_better(worth[best, -1], worth[stated, -1]):
            raise InputError(
                f"{where} is {_READINGS[ways[best]]}, given as {_READINGS[ways[stated]]}: the "
                f"cloud shows it (median error {at(best)} against {at(stated)}). State what it is."
            )
        worse = medians[stated, gauge] > _WORSE * medians[stated, -1]
        if worse and far_better(worth[stated, -1], worth[stated, gauge]):
            raise InputError(
                f"{where} is no depth {_GAUGES[prior.gauge]}: its median error at the cloud is "
                f"{at(stated, gauge)}, and {at(stated)} {_GAUGES['affine']} (`gauge` affine)."
            )
        return prior
    plain = ways.index((ways[best][0], "axis"))
    if not far_better(worth[best, -1], worth[plain, -1]):
        best = plain
    gauge = [far_better(worth[best, -1], one) for one in worth[best]].index(False)
    (inverse, along), found = ways[best], gauges[gauge]
    caution(
        f"{where} is taken to be {_READINGS[ways[best]]} {_GAUGES[found]}, as the cloud shows: its "
        f"median error at {errors.shape[-1]} observations is {at(best, gauge)}. `inverse`, `along` "
        "and `gauge` state it.",
        stacklevel=4,
    )
    return prior.replace(inverse=inverse, along=along, gauge=found)


@torch.no_grad()
def _errors(
    prior: DepthPrior, scene: SparseScene
) -> tuple[Float[Tensor, "reading gauge observation"], Int[Tensor, " observation"]]:
    """Return relative errors of all readings, and last of none, and each observation's point."""
    seen = at_points(prior, prior.variance.isfinite(), scene)
    count = torch.bincount(seen.place[:, 0], minlength=len(prior.names))
    seen = seen.take(count[seen.place[:, 0]] >= _FEWEST)
    K, ends = scene.cameras.intrinsics[seen.view], homogeneous(seen.pixels)[..., None]
    lengths = torch.linalg.solve(K, ends).norm(dim=1)[:, 0].double()
    values, axis = prior.depth[seen.place.unbind(dim=-1)].double(), seen.depth.double()
    depths = [axis * lengths if along == "ray" else axis for _, along in _READINGS]
    truths = [
        1 / depth if inverse else depth
        for depth, (inverse, _) in zip(depths, _READINGS, strict=True)
    ]
    pairs = [*((values, truth) for truth in truths), (torch.zeros_like(values), axis)]
    found = [_of_gauges(*pair, seen.place[:, 0]) for pair in pairs]
    return torch.stack(found), seen.point


def _of_gauges(
    values: Float[Tensor, " observation"],
    truth: Float[Tensor, " observation"],
    group: Int[Tensor, " observation"],
) -> Float[Tensor, "gauge observation"]:
    """Return relative errors in the scene's unit, up to a factor, and up to factor and offset."""
    found = torch.stack([values, torch.zeros_like(values), torch.zeros_like(values)])
    for one in torch.unique(group):
        here = group == one
        for gauge in (1, 2):
            found[gauge, here] = _line(values[here], truth[here], offset=gauge == 2)
    return (found - truth).abs() / truth


def _line(
    values: Float[Tensor, " point"], truth: Float[Tensor, " point"], *, offset: bool
) -> Float[Tensor, " point"]:
    """Fit ``a values + b``, ``a`` at least 0, for small absolute errors; return the fit."""
    weight = torch.ones_like(truth)
    fit = truth
    for _ in range(_STEPS):
        total = weight.sum()
        means = [
            (weight * one).sum() / total if offset else one.new_zeros(()) for one in (values, truth)
        ]
        across, along = values - means[0], truth - means[1]
        squares = (weight * across.square()).sum()
        slope = ((weight * across * along).sum() / squares.clamp_min(1e-300)).clamp_min(0)
        fit = means[1] + slope * across
        error = (fit - truth).abs()
        weight = 1 / error.clamp_min(1e-3 * float(error.median()) + 1e-12 * float(truth.mean()))
    return fit
