"""Low-rank factorization of matrices with missing entries: the problem, and what solves it."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.photometry.quadratics import PackedCholesky, outer
from pimper_torch.records import Convergence, Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LowRank(Record):
    r"""Factors of a batch of matrices, :math:`X \approx L R`.

    Unique at best up to one invertible matrix between ``L`` and ``R``.

    Attributes:
        left: ``L``.
        right: ``R``, the best one for ``L``.
        convergence: Of each matrix; its residual is the root mean square over the entries by
            weight, :math:`\sqrt{\sum w (X - L R)^2 / \sum w}`.
    """

    left: Float[Tensor, "batch row rank"]
    right: Float[Tensor, "batch rank column"]
    convergence: Convergence


def solve_right(
    matrix: Float[Tensor, "batch row column"],
    weight: Float[Tensor, "batch row column"],
    left: Float[Tensor, "batch row rank"],
) -> tuple[Float[Tensor, "batch rank column"], PackedCholesky]:
    """Solve for every column's coefficients, the left factor given.

    Returns:
        The right factor, and the factored normal equations of its columns, with an axis of
        length one after the batch. A column with fewer entries than the rank takes one of
        its best coefficients.
    """
    factored = PackedCholesky((outer(left.mT) @ weight)[:, None], left.shape[-1])
    return factored.solve((left.mT @ (weight * matrix))[:, None])[:, 0], factored


def squared_error(
    matrix: Float[Tensor, "batch row column"],
    weight: Float[Tensor, "batch row column"],
    left: Float[Tensor, "batch row rank"],
    right: Float[Tensor, "batch rank column"],
) -> Float[Tensor, " batch"]:
    """Give ``sum w (X - L R)^2`` of each matrix."""
    return (weight * (matrix - left @ right).square()).sum(dim=(1, 2))


def finished(
    matrix: Float[Tensor, "batch row column"],
    weight: Float[Tensor, "batch row column"],
    left: Float[Tensor, "batch row rank"],
    iterations: Int[Tensor, " batch"],
    limit: int,
) -> LowRank:
    """Put a solution together."""
    right, _ = solve_right(matrix, weight, left)
    total = weight.sum(dim=(1, 2)).clamp_min(torch.finfo(weight.dtype).tiny)
    return LowRank(
        left=left,
        right=right,
        convergence=Convergence(
            iterations=iterations,
            residual=(squared_error(matrix, weight, left, right) / total).sqrt(),
            converged=iterations < limit,
        ),
    )


def checked(
    matrix: Float[Tensor, "batch row column"],
    weight: Float[Tensor, "batch row column"],
    rank: int,
) -> tuple[Float[Tensor, "batch row column"], Float[Tensor, "batch row column"]]:
    """Give matrices and weights in float64, entries without weight zero.

    Raises:
        InputError: A rank that the matrices do not have, a weight that is negative, or an
            entry with weight that is not a number.
    """
    rows, columns = matrix.shape[1:]
    if not 1 <= rank <= min(rows, columns):
        raise InputError(
            f"rank is {rank}; needed: between 1 and {min(rows, columns)} for matrices of "
            f"{rows} x {columns}."
        )
    heavy = weight.double()
    if not bool(((heavy >= 0) & heavy.isfinite()).all()):
        raise InputError("weights must be finite and not negative; found others.")
    seen = heavy > 0
    if not bool(matrix[seen].isfinite().all()):
        count = int((~matrix[seen].isfinite()).sum())
        raise InputError(
            f"{count} entries with weight are not finite; needed: numbers. Give them weight 0."
        )
    return torch.where(seen, matrix.double(), 0), heavy


def random_left(
    batch: int, rows: int, rank: int, generator: torch.Generator
) -> Float[Tensor, "batch row rank"]:
    """Draw orthonormal left factors, evenly over all subspaces."""
    drawn = torch.randn(batch, rows, rank, generator=generator, dtype=torch.float64)
    return torch.linalg.qr(drawn).Q
