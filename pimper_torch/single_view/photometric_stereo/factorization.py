r"""Low-rank factorization of photographs from one viewpoint, robust to shadows.

:math:`X = L S`, one row of ``L`` a view, one column of ``S`` a pixel: unique at best up to one
invertible matrix between them.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.photometry.variable_projection import solve_variable_projection
from pimper_torch.records import Record
from pimper_torch.single_view.factorization.low_rank import low_rank_problem
from pimper_torch.single_view.photometric_stereo.regression import brightness, regress, reweigh

# Lights are estimated from so many pixels at most, shading for all: a choice.
_MAX_PIXELS = 4000
# Steps of variable projection: for the first solution, and after every change of weights: choices.
_FIRST_STEPS, _NEXT_STEPS = 100, 5
_ITERATIONS = 20
_WIDEST, _NARROWING = 4.0, 0.8


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Factored(Record):
    """Factors of the photographs.

    Attributes:
        lights: ``L``, orthonormal columns.
        shading: ``S``; the noise of its components is white.
        weight: Final weight of each sample; 0 where missing or in shadow.
    """

    lights: Float[Tensor, "view rank"]
    shading: Float[Tensor, "rank pixel"]
    weight: Float[Tensor, "view pixel"]


def factorize_photographs(
    radiance: Float[Tensor, "view pixel"],
    weight: Float[Tensor, "view pixel"],
    rank: int,
    *,
    robust: bool = True,
) -> Factored:
    """Factorize photographs with missing samples, shadows and highlights.

    Complete and without robust weights, it is the singular value decomposition. Otherwise lights
    are estimated from an even subset of pixels by variable projection, with Cauchy's weights if
    ``robust``; the shading of all pixels is regressed on them.

    Args:
        radiance: Linear, gray. Samples without weight are ignored.
        weight: Not negative; 0 where missing.
        robust: Whether to reweight; see
            :func:`~pimper_torch.single_view.photometric_stereo.regression.regress`.

    Constant to autograd.

    Source: Hayakawa, JOSA A 11(11), 1994, for the decomposition; variable projection as in
    :mod:`pimper_torch.photometry.variable_projection`.
    """
    with torch.no_grad():
        seen = weight > 0
        x = torch.where(seen, radiance, 0).double()
        given = weight.double()
        usable = torch.nonzero(seen.sum(dim=0) > rank)[:, 0]
        views = int(seen.any(dim=1).sum())
        if views < rank or len(usable) <= rank:
            raise InputError(
                f"factorization: {views} views have samples, {len(usable)} pixels more than "
                f"{rank}; needed: {rank} views and more than {rank} such pixels. Add photographs "
                "or widen the mask."
            )
        if not robust and bool((given == given[seen].max()).all()):
            left = torch.linalg.eigh(x @ x.mT).eigenvectors[:, -rank:].flip(1)
            return Factored(lights=left, shading=left.mT @ x, weight=given)
        some = usable[evenly(len(usable), _MAX_PIXELS).to(usable.device)]
        first = given[:, some]
        if robust:
            first = first * brightness(x[:, some], seen[:, some])
        begin = _filled(x[:, some], first, rank)
        problem = low_rank_problem(x[None, :, some], first[None], begin[None])
        left = solve_variable_projection(problem, _FIRST_STEPS).lights[0]
        if robust:
            left = _settle(x[:, some], given[:, some], first, left)
        found = regress(x, given, left, robust=robust)
        return Factored(lights=left, shading=found.shading, weight=found.weight)


def _settle(
    x: Float[Tensor, "view pixel"],
    given: Float[Tensor, "view pixel"],
    first: Float[Tensor, "view pixel"],
    left: Float[Tensor, "view rank"],
) -> Float[Tensor, "view rank"]:
    """Alternate weights and factors, the scale of the weights falling to its final value."""
    weight = first
    for iteration in range(_ITERATIONS):
        problem = low_rank_problem(x[None], weight[None], left[None])
        solved = solve_variable_projection(problem, _NEXT_STEPS)
        left = solved.lights[0]
        widen = max(1.0, _WIDEST * _NARROWING**iteration)
        reliability, lit = reweigh(x, given, left @ solved.shading[0], widen)
        weight = reliability * lit
    return left


def _filled(
    x: Float[Tensor, "view pixel"], weight: Float[Tensor, "view pixel"], rank: int
) -> Float[Tensor, "view rank"]:
    """Impute missing samples by view's times pixel's brightness, and take singular vectors."""
    gain = (weight * x).sum(dim=1, keepdim=True) / weight.sum(dim=1, keepdim=True).clamp_min(1e-12)
    level = (weight * gain).sum(dim=0, keepdim=True).clamp_min(1e-12)
    albedo = (weight * x).sum(dim=0, keepdim=True) / level
    fraction = weight / weight.amax().clamp_min(1e-300)
    filled = fraction * x + (1 - fraction) * gain * albedo
    return torch.linalg.eigh(filled @ filled.mT).eigenvectors[:, -rank:].flip(1)


def evenly(count: int, most: int) -> Int[Tensor, " chosen"]:
    """Return indices spaced evenly over ``range(count)``."""
    return torch.linspace(0, count - 1, min(count, most)).round().long()
