"""Low-rank factorization of matrices with missing entries, as a problem for the solvers."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.photometry.bilinear import Bilinear
from pimper_torch.single_view.factorization.manifolds import Free


def low_rank_problem(
    matrix: Float[Tensor, "batch row column"],
    weight: Float[Tensor, "batch row column"],
    start: Float[Tensor, "batch row rank"],
) -> Bilinear:
    r"""Return the problem :math:`\min \sum w (X - L N)^2` over factors of low rank, in float64.

    Rows are the problem's views, columns its samples: ``L`` becomes ``lights``, ``N``
    ``shading``. They are unique at best up to one invertible matrix between them.

    Args:
        matrix: ``X``; entries without weight are ignored.
        weight: 0 where missing.
        start: Left factors of full rank.

    Raises:
        InputError: A rank that the matrices do not have, a weight that is negative, or an
            entry with weight that is not a number.
    """
    rows, columns = matrix.shape[1:]
    rank = start.shape[2]
    if not 1 <= rank <= min(rows, columns):
        raise InputError(
            f"rank is {rank}; needed: between 1 and {min(rows, columns)} for matrices of "
            f"{rows} x {columns}."
        )
    heavy = weight.double().contiguous()
    if not bool(((heavy >= 0) & heavy.isfinite()).all()):
        raise InputError("weights must be finite and not negative; found others.")
    seen = heavy > 0
    if not bool(matrix[seen].isfinite().all()):
        count = int((~matrix[seen].isfinite()).sum())
        raise InputError(
            f"{count} entries with weight are not finite; needed: numbers. Give them weight 0."
        )
    known = torch.where(seen, matrix.double(), 0).contiguous()
    left = start.double()
    return Bilinear(
        radiance=known,
        weight=heavy,
        lights=left,
        anchor=left,
        shading=known.new_zeros(len(known), rank, columns),
        regularization=known.new_zeros(len(known), rows),
        manifold=Free(rank=rank),
    )


def singular_left(
    matrix: Float[Tensor, "batch row column"],
    weight: Float[Tensor, "batch row column"],
    rank: int,
    guess: Float[Tensor, "batch row column"] | None = None,
    imputations: int = 20,
) -> Float[Tensor, "batch row rank"]:
    """Initialize by singular vectors of the matrix, missing entries imputed iteratively.

    Missing entries start from a guess, by default the mean of their row, and are replaced by the
    low-rank approximation in turn. Orthonormal; in float64.
    """
    seen = weight > 0
    known = torch.where(seen, matrix.double(), 0)
    if guess is None:
        guess = known.sum(dim=2, keepdim=True) / seen.sum(dim=2, keepdim=True).clamp_min(1)
    filled = torch.where(seen, known, guess.double())
    left = _leading(filled, rank)
    for _ in range(imputations):
        filled = torch.where(seen, known, left @ (left.mT @ filled))
        left = _leading(filled, rank)
    return left


def random_left(
    batch: int, rows: int, rank: int, generator: torch.Generator
) -> Float[Tensor, "batch row rank"]:
    """Draw orthonormal left factors, evenly over all subspaces."""
    drawn = torch.randn(batch, rows, rank, generator=generator, dtype=torch.float64)
    return torch.linalg.qr(drawn).Q


def _leading(filled: Float[Tensor, "batch row column"], rank: int) -> Float[Tensor, "..."]:
    return torch.linalg.eigh(filled @ filled.mT).eigenvectors[..., -rank:]
