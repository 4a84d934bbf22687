"""Whether maps hold depth or one over it, along which way, and up to what, by the cloud.

A reading says how values ``d`` of a map belong to depth ``t`` of the points that the view
observes: ``t = a d + b`` with ``a`` above 0, where ``t`` is depth, distance, or one over either.
"""

from itertools import product
from typing import Literal, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.errors import InputError, caution, some
from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.priors.at_points import at_points, means_by
from pimper_torch.records import DepthPrior, SparseScene
from pimper_torch.sfm.squares import ERRORS, standard_errors

Gauge = Literal["scene", "scale", "affine"]
_READINGS = tuple(product((False, True), ("axis", "ray")))
_GAUGES: tuple[Gauge, ...] = ("scene", "scale", "affine")
# Choices: points of a map that a line is fitted to at least; steps of reweighting; by how much the
# median error must grow for a simpler gauge, or a stated one, to be wrong.
_FEWEST, _STEPS, _WORSE = 8, 20, 2.0


def settled_depth(prior: DepthPrior, scene: SparseScene) -> DepthPrior:
    """Decide what depth means.

    Where it is left open it is found, which is told in a warning: whether it is one over depth,
    along the axis unless along the ray fits far better, and the simplest gauge that fits.

    Args:
        prior: Of undistorted photographs.

    Raises:
        InputError: Another reading than the stated one fits far better, none is better than no
            depth at all, or there are too few points.
    """
    where = f"The depth of {len(prior.names)} photographs ({some(prior.names, most=1)})"
    errors, point = _errors(prior.detach(), scene)
    enough = errors.shape[-1] >= _FEWEST
    if prior.inverse is not None and not enough:
        return prior
    if not enough:
        raise InputError(
            f"{where}: too few points of the cloud are seen where it is known; needed: {_FEWEST}. "
            "State whether it is one over depth (`inverse`), and its gauge."
        )
    size = errors[:, -1].median(dim=-1).values.min()
    worth = means_by(size / (size + errors), point)
    affine = worth[:-1, -1]
    best = int(affine.mean(dim=-1).argmax())

    def far_better(one: Tensor, other: Tensor) -> bool:
        return standard_errors(one - other) > ERRORS

    if not far_better(affine[best], worth[-1, -1]):
        raise InputError(
            f"{where} fits the cloud no better than a plane across the view, as depth or as "
            "one over depth. Photographs and maps may be mixed up, or maps be of another size."
        )
    if prior.inverse is not None:
        stated = _READINGS.index((prior.inverse, prior.along))
        gauge = _GAUGES.index(prior.gauge)
        medians = errors[stated].median(dim=-1).values
        if best != stated and far_better(affine[best], affine[stated]):
            raise InputError(
                f"{where} is {_meaning(best)}, given as {_meaning(stated)}: the cloud shows it "
                f"(median error {_percent(errors[best, -1])} against "
                f"{_percent(errors[stated, -1])}). State it, or leave it open."
            )
        if medians[gauge] > _WORSE * medians[-1] and far_better(
            worth[stated, -1], worth[stated, gauge]
        ):
            raise InputError(
                f"{where} is no depth {_up_to(prior.gauge)}: its median error at the cloud is "
                f"{_percent(errors[stated, gauge])}, and {_percent(errors[stated, -1])} up to a "
                "factor and an offset a map (`gauge` affine)."
            )
        return prior
    inverse, along = _READINGS[best]
    plain = _READINGS.index((inverse, "axis"))
    if not far_better(affine[best], affine[plain]):
        best, along = plain, "axis"
    fits = [not far_better(worth[best, -1], one) for one in worth[best]]
    gauge_found = _GAUGES[fits.index(True)]
    caution(
        f"{where} is taken to be {_meaning(best)} {_up_to(gauge_found)}, as the cloud shows: its "
        f"median error at {errors.shape[-1]} observations is "
        f"{_percent(errors[best, _GAUGES.index(gauge_found)])}. `inverse`, `along` and `gauge` "
        "state it.",
        stacklevel=4,
    )
    return prior.replace(
        inverse=inverse, along=cast(Literal["axis", "ray"], along), gauge=gauge_found
    )


def _meaning(reading: int) -> str:
    inverse, along = _READINGS[reading]
    way = "along the camera's axis" if along == "axis" else "along the ray"
    return f"one over depth (disparity) {way}" if inverse else f"depth {way}"


def _up_to(gauge: Gauge) -> str:
    return {
        "scene": "in the scene's unit",
        "scale": "up to a factor a map",
        "affine": "up to a factor and an offset a map",
    }[gauge]


def _percent(errors: Tensor) -> str:
    return f"{float(errors.median()):.1%}"


@torch.no_grad()
def _errors(
    prior: DepthPrior, scene: SparseScene
) -> tuple[Float[Tensor, "reading gauge observation"], Int[Tensor, " observation"]]:
    """Return relative errors of all readings, and last of none, and each observation's point."""
    seen = at_points(prior, prior.variance.isfinite(), scene)
    count = torch.bincount(seen.place[:, 0], minlength=len(prior.names))
    kept = count[seen.place[:, 0]] >= _FEWEST
    seen = seen.take(kept)
    rays = torch.linalg.solve(
        scene.cameras.intrinsics[seen.view], homogeneous(seen.pixels)[..., None]
    )[..., 0]
    lengths = rays.norm(dim=-1).double()
    values = prior.depth[seen.place.unbind(dim=-1)].double()
    found = []
    for inverse, along in _READINGS:
        depth = seen.depth.double() * (lengths if along == "ray" else 1)
        found.append(_of_gauges(values, 1 / depth if inverse else depth, seen.place[:, 0]))
    found.append(_of_gauges(torch.zeros_like(values), seen.depth.double(), seen.place[:, 0]))
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
