r"""Least squares over terms of several kinds, whose noise is estimated with the solution.

The stated variances of a kind are correct up to one factor. It is the robust ratio of its squared
residuals to their expectation: ``m`` equations have the redundancy
:math:`m - \mathrm{tr}(A_k A^{-1})`, with :math:`A_k` the contribution of the kind to the matrix of
the system. Outliers lose weight by Cauchy's function as the factors converge.

Source: Förstner, Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten, 1979, for
the factors; Hutchinson, A stochastic estimator of the trace, 1989, for the trace.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.kernels.arrays import as_array
from pimper_torch.kernels.switch import compiled_for
from pimper_torch.linalg.least_squares import compressed_equations, normal_equations
from pimper_torch.linalg.prepared import SingularSystemError
from pimper_torch.linalg.robust import CAUCHY_TUNING, robust_variance
from pimper_torch.linalg.sums import total
from pimper_torch.linalg.systems import solutions, solve_compressed
from pimper_torch.records import Record
from pimper_torch.records.shapes import PerVertex, Scalar
from pimper_torch.runtime.failures import skipped_solver
from pimper_torch.stages.fusion.equations import Equations

# Relative tolerances of the heights in the energy norm: of results, for noise estimates, and for
# gradients. With 1e-5 vertices of the demo move by 5e-5 of a spacing, with 1e-3 by 1.6e-3, which is
# enough for noise estimates.
_ACCURATE, _ESTIMATING, _EXACT = 1e-6, 1e-4, 1e-8

# Stated standard errors are assumed to be at most twice the true ones: residuals of a kind that
# outweighs all others vanish, which would increase its weight without bound.
_MIN_FACTOR = 0.25


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FusedHeights(Record):
    """The heights, the noise factor of each kind of terms, and the last system.

    Attributes:
        factors: Noise factor by which the stated variances of each kind were multiplied.
        weights: Robust weights of every kind's equations; outliers have less than 1.
        damping: Information of the initial heights.
    """

    heights: PerVertex
    factors: tuple[Scalar, ...]
    kinds: tuple[Equations, ...]
    weights: tuple[Float[Tensor, " _"], ...]
    damping: PerVertex

    def system(
        self, targets: Sequence[Float[Tensor, " _"]], start: PerVertex
    ) -> tuple[csr_array, PerVertex]:
        """Return the last system for other targets and initial heights, without gradients."""
        kinds = [kind.replace(targets=t) for kind, t in zip(self.kinds, targets, strict=True)]
        return _compressed(kinds, self.weights, self.factors, start, self.damping)


def fuse_terms(
    kinds: Sequence[Equations],
    start: PerVertex,
    damping: PerVertex,
    iterations: int,
    factors: Sequence[Scalar] | None = None,
) -> FusedHeights:
    """Return the solution; solves and estimates of the noise alternate.

    Args:
        kinds: Equations of every kind; kinds without equations are skipped.
        start: Heights that vertices keep without other terms.
        factors: Noise factors, if known.

    Differentiable in targets, coefficients, information, damping and start, also through weights
    and factors: every solve is differentiated by the implicit function theorem, so gradients take
    as many solves again.

    If the equations have no solution, heights are those of the previous solve, or ``start``, and
    this is reported (:func:`~pimper_torch.runtime.failures.skipped`).
    """
    unit = torch.ones((), dtype=torch.float64, device=start.device)
    noise = [unit for _ in kinds] if factors is None else list(factors)
    weights = [torch.ones_like(kind.information).double() for kind in kinds]
    generator = torch.Generator().manual_seed(0)  # random signs for the trace; any seed
    probe = 2.0 * torch.randint(0, 2, (len(start),), generator=generator) - 1
    probe = probe.double().to(start.device)
    heights: Tensor | None = None
    try:
        for _ in range(iterations - 1):
            heights, answer = _solved(
                kinds, weights, noise, start, damping, probe, guess=heights, tolerance=_ESTIMATING
            )
            for index, kind in enumerate(kinds):
                if not kind.evaluated or len(kind.targets) == 0:
                    continue
                square, used = _evaluated(kind, weights[index], heights, probe, answer)
                redundancy = 1 - used / noise[index] / total(weights[index])
                # The estimate by random signs may be negative.
                square = square / redundancy.clamp_min(0.05)
                if factors is None:
                    # The factor's standard error is then below 0.2 %.
                    noise[index] = noise_factor(square[:: max(1, len(square) // 500_000)])
                weights[index] = 1 / (1 + square / (CAUCHY_TUNING**2 * noise[index]))
        (heights,) = _solved(
            kinds, weights, noise, start, damping, guess=heights, tolerance=_ACCURATE
        )
    except SingularSystemError as error:
        _kept(error)
    return FusedHeights(
        heights=start.double() if heights is None else heights,
        factors=tuple(noise),
        kinds=tuple(kinds),
        weights=tuple(weights),
        damping=damping,
    )


def fuse_like(fused: FusedHeights, kinds: Sequence[Equations], start: PerVertex) -> FusedHeights:
    """Return the solution for terms with common errors, with the weights of a previous one.

    Residuals between vertices do not contain the common error of normals: slopes seem to have less
    noise than stated, and points that contradict them more. Therefore the factors of slopes are at
    least 1 here, and all others at most 1.

    Args:
        kinds: The same terms, in order; only information and correlation may differ.
        start: Heights that vertices keep without other terms.

    Differentiable like :func:`fuse_terms`, also through weights and factors. If the equations have
    no solution, the heights are those of the previous solve.
    """
    factors = tuple(
        factor.clamp_min(1) if kind.is_slope else factor.clamp_max(1)
        for kind, factor in zip(kinds, fused.factors, strict=True)
    )
    heights = fused.heights
    try:
        (heights,) = _solved(
            kinds, fused.weights, factors, start, fused.damping, guess=heights, tolerance=_ACCURATE
        )
    except SingularSystemError as error:
        _kept(error)
    return fused.replace(heights=heights, factors=factors, kinds=tuple(kinds))


def _kept(error: SingularSystemError) -> None:
    done = "The surface before that solve is kept: of an earlier solve, or of the patches"
    skipped_solver("fuse", "the fusion", error, done)


def _solved(
    kinds: Sequence[Equations],
    weights: Sequence[Float[Tensor, " _"]],
    factors: Sequence[Scalar],
    start: PerVertex,
    damping: PerVertex,
    *further: PerVertex,
    guess: PerVertex | None,
    tolerance: float,
) -> tuple[PerVertex, ...]:
    """Return the heights, and the solutions for more right-hand sides of the same matrix."""
    tensors = [x for kind in kinds for x in (kind.coefficients, kind.targets, kind.information)]
    if not compiled_for(start, damping, *tensors, *weights, *factors):
        entries, rhs = _system(kinds, weights, factors, start, damping)
        return solutions(*entries, rhs, *further, what="the fusion", tolerance=_EXACT)
    matrix, rhs = _compressed(kinds, weights, factors, start, damping)
    initial = None
    if guess is not None:
        initial = torch.stack([guess, *(torch.zeros_like(guess) for _ in further)], dim=1)
    sides = torch.stack([rhs, *further], dim=1)
    result = solve_compressed(matrix, sides, what="the fusion", tolerance=tolerance, start=initial)
    return result.unbind(dim=1)


def _compressed(
    kinds: Sequence[Equations],
    weights: Sequence[Float[Tensor, " _"]],
    factors: Sequence[Scalar],
    start: PerVertex,
    damping: PerVertex,
) -> tuple[csr_array, PerVertex]:
    terms = [
        (kind.unknowns, kind.coefficients, kind.targets, weight * kind.information / factor)
        for kind, weight, factor in zip(kinds, weights, factors, strict=True)
    ]
    return compressed_equations(terms, damping, start)


def _evaluated(
    kind: Equations,
    weight: Float[Tensor, " equation"],
    heights: PerVertex,
    probe: PerVertex,
    answer: PerVertex,
) -> tuple[Float[Tensor, " equation"], Scalar]:
    """Return squared residuals over the stated variance, and the used degrees of freedom."""
    tensors = kind.coefficients, kind.targets, kind.information, kind.correlated
    if compiled_for(*tensors, weight, heights, answer):
        from pimper_torch.kernels import normal_equations as kernels

        square = torch.empty_like(weight)
        real = torch.promote_types(kind.coefficients.dtype, kind.targets.dtype)
        arrays = [as_array(kind.unknowns), *(as_array(tensor, real) for tensor in tensors)]
        arrays += [as_array(tensor) for tensor in (weight, heights, probe, answer, square)]
        evaluate: Any = kernels.judge
        return square, torch.tensor(evaluate(*arrays), dtype=torch.float64)
    square = kind.information.double() * kind.residual(heights).square() * kind.correlated
    used = weight * kind.information * _sum(kind, probe) * _sum(kind, answer)
    return square, total(used)


def noise_factor(square: Float[Tensor, " equation"]) -> Scalar:
    """Return a robust variance of Gaussian noise from its squares. Differentiable.

    Args:
        square: Squared residuals over the stated variance and over the redundancy per equation.

    >>> noise = torch.randn(10000, generator=torch.Generator().manual_seed(1))
    >>> bool(abs(noise_factor(4 * noise.double().square()) - 4) < 0.2)
    True
    """
    everything = torch.ones_like(square, dtype=torch.bool)
    return robust_variance(square, everything).clamp_min(_MIN_FACTOR)


def _sum(kind: Equations, values: PerVertex) -> Float[Tensor, " equation"]:
    return (kind.coefficients * values[kind.unknowns]).sum(dim=1)


def _system(
    kinds: Sequence[Equations],
    weights: Sequence[Float[Tensor, " _"]],
    factors: Sequence[Scalar],
    start: PerVertex,
    damping: PerVertex,
) -> tuple[tuple[Int[Tensor, " entry"], Int[Tensor, " entry"], Float[Tensor, " entry"]], PerVertex]:
    """Return rows, columns and values of the matrix, and the right-hand side."""
    diagonal = torch.arange(len(start), device=start.device)
    rows, cols, values = [diagonal], [diagonal], [damping.double()]
    rhs = damping.double() * start.double()
    for kind, weight, factor in zip(kinds, weights, factors, strict=True):
        row, col, value, side = normal_equations(
            kind.unknowns,
            kind.coefficients.double(),
            kind.targets.double(),
            weight * kind.information.double() / factor,
            len(start),
        )
        rows.append(row)
        cols.append(col)
        values.append(value)
        rhs = rhs + side
    return (torch.cat(rows), torch.cat(cols), torch.cat(values)), rhs
