"""Factorization from random starts, until the best minimum repeats."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.photometry.bilinear import Factors
from pimper_torch.photometry.variable_projection import solve_variable_projection
from pimper_torch.records import Record
from pimper_torch.single_view.factorization.low_rank import low_rank_problem, random_left

# Residuals below this fraction of the data are zero but for rounding.
_ROUNDING = 1e-6
# Choices: the steps of a start, its tolerance, and the fraction by which residuals of the same
# minimum differ.
_STEPS, _TOLERANCE, _CLOSENESS = 300, 1e-9, 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Restarted(Record):
    """The best of several factorizations of one matrix.

    Attributes:
        best: A batch of one, rows as views and columns as samples.
        repeated: Whether ``repeats`` starts reached the best minimum; if not, there may well be a
            better one.
    """

    best: Factors
    residuals: Float[Tensor, " start"]
    repeated: bool


def factorize_from_many(
    matrix: Float[Tensor, "row column"],
    weight: Float[Tensor, "row column"],
    rank: int,
    generator: torch.Generator,
    *,
    repeats: int = 2,
    max_starts: int = 50,
) -> Restarted:
    """Factorize a matrix with missing entries from random starts until the best repeats.

    Args:
        matrix: Entries without weight are ignored.
        weight: 0 where missing.
        generator: On the CPU.
        repeats: How many starts must end in the best minimum.

    Raises:
        InputError: ``max_starts`` below ``repeats``, or an invalid matrix, weight or rank.
    """
    if not 1 <= repeats <= max_starts:
        raise InputError(
            f"repeats is {repeats} and max_starts {max_starts}; needed: 1 <= repeats <= max_starts."
        )
    best: Factors | None = None
    residuals: list[float] = []
    repeated = False
    seen = weight > 0
    level = float((weight[seen] * matrix[seen].square()).sum() / weight[seen].sum()) ** 0.5
    while len(residuals) < max_starts:
        start = random_left(1, matrix.shape[0], rank, generator).to(matrix.device)
        problem = low_rank_problem(matrix[None], weight[None], start)
        found = solve_variable_projection(problem, _STEPS, _TOLERANCE)
        residuals.append(float(found.convergence.residual))
        if best is None or residuals[-1] < float(best.convergence.residual):
            best = found
        # On exact data the residuals are rounding, and all differ.
        same = max(min(residuals) * (1 + _CLOSENESS), _ROUNDING * level)
        repeated = sum(one <= same for one in residuals) >= repeats
        if repeated:
            break
    assert best is not None
    return Restarted(
        best=best,
        residuals=torch.tensor(residuals, dtype=torch.float64),
        repeated=repeated,
    )
