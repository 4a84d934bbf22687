r"""Least squares over evidence of several kinds, whose noise is estimated along with the answer.

Every kind claims variances that are right up to one factor. The factor is what its residuals
show, divided by what they should show: of :math:`m` equations with the weights of the solution,
:math:`m - \mathrm{tr}(A_k A^{-1})` are left over to tell. Outliers lose weight by Cauchy's
function as they go.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.fusion.evidence import Evidence
from pimper_torch.linalg.equations import normal_equations
from pimper_torch.linalg.systems import prepare
from pimper_torch.records import Record

# Cauchy's weights are 95 % efficient on Gaussian noise with this many standard deviations.
_CAUCHY = 2.385

# Of the heights, in the energy norm, relative: far below what the evidence leaves open.
_ACCURACY = 1e-5

# The mean weight and the mean weighted square of Gaussian noise under these weights.
_EXPECTED = 0.802


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Fused(Record):
    """The heights, and how far each kind of evidence was right about itself.

    Attributes:
        heights: Of all vertices, float64.
        factors: By which the variances that each kind claims must be multiplied.
        weights: Of each kind's equations in the last solve.
    """

    heights: Float[Tensor, " vertex"]
    factors: tuple[float, ...]
    weights: tuple[Float[Tensor, " _"], ...]


def fuse_evidence(
    kinds: Sequence[Evidence],
    start: Float[Tensor, " vertex"],
    prior: Float[Tensor, " vertex"],
    rounds: int,
    generator: torch.Generator,
) -> Fused:
    """Solve, judge the noise, and solve again.

    Args:
        kinds: Of evidence.
        start: Heights that unknown vertices keep.
        prior: Information that they keep them by.
        rounds: Of solves.
        generator: Of the signs that the trace is estimated with.

    Differentiable in targets, coefficients and information through the last solve, whose
    weights are constants.
    """
    count = len(start)
    factors = [1.0 for _ in kinds]
    weights = [torch.ones_like(kind.information).double() for kind in kinds]
    everything = torch.arange(count, device=start.device)
    heights = start.double()
    probe = torch.randint(0, 2, (count,), generator=generator).to(heights) * 2 - 1
    for again in range(rounds):
        last = again == rounds - 1
        with torch.set_grad_enabled(last and torch.is_grad_enabled()):
            rows, cols, values = [everything], [everything], [prior.double()]
            rhs = prior.double() * start.double()
            for kind, weight, factor in zip(kinds, weights, factors, strict=True):
                one = normal_equations(
                    kind.unknowns,
                    kind.coefficients.double(),
                    kind.targets.double(),
                    weight * kind.information.double() / factor,
                    count,
                )
                rows.append(one[0])
                cols.append(one[1])
                values.append(one[2])
                rhs = rhs + one[3]
            matrix = prepare(
                torch.cat(rows), torch.cat(cols), torch.cat(values), count, what="the fusion",
                tolerance=_ACCURACY,
            )
            heights = matrix.solve(rhs)
        if last:
            break
        with torch.no_grad():
            spread_out = matrix.solve(probe)
            for place, kind in enumerate(kinds):
                if not kind.judged:
                    continue
                residual = kind.residual(heights)
                information = kind.information.double()
                weight = weights[place] * information / factors[place]
                taken = float(
                    (
                        weight
                        * (kind.coefficients * probe[kind.unknowns]).sum(dim=1)
                        * (kind.coefficients * spread_out[kind.unknowns]).sum(dim=1)
                    ).sum()
                )
                square = information * residual.square() * kind.correlated
                left = max(1 - taken / max(float(weights[place].sum()), 1e-12), 0.05)
                factors[place] = _scale(square, factors[place], left)
                weights[place] = 1 / (1 + square / (_CAUCHY**2 * factors[place]))
    return Fused(heights=heights, factors=tuple(factors), weights=tuple(weights))


def _scale(square: Float[Tensor, " equation"], factor: float, left: float) -> float:
    """Find the factor under which the weighted squares are as large as noise would have them."""
    if len(square) == 0:
        return factor
    for _ in range(20):
        weight = 1 / (1 + square / (_CAUCHY**2 * factor))
        shown = float((weight * square).mean()) / (_EXPECTED * left)
        factor = max(shown, 1e-12)
    return factor
