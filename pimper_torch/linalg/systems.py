"""One door to the solvers of sparse matrices: whichever suits size and device."""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.linalg.multigrid import DEFAULT_TOLERANCE, Multigrid
from pimper_torch.linalg.sparse import SparseCholesky

# Here a factor takes three times as long to make as a hierarchy, and a third as long to use; it
# is exact, and half a second is soon earned back by the three coordinates of a surface.
_CHOLESKY_UNKNOWNS = 50_000

# Multigrid is made for matrices whose entries off the diagonal are negative but for this share.
_POSITIVE_SHARE = 0.1


def prepare(
    rows: Int[Tensor, " entry"],
    cols: Int[Tensor, " entry"],
    values: Float[Tensor, " entry"],
    size: int,
    what: str = "the linear system",
    *,
    method: Literal["auto", "cholesky", "multigrid"] = "auto",
    tolerance: float = DEFAULT_TOLERANCE,
) -> SparseCholesky | Multigrid:
    """Prepare a sparse symmetric positive definite matrix for any number of solves.

    Args:
        rows: Row of each entry; entries named twice add up.
        cols: Column of each entry.
        values: Of the entries; solutions are differentiable in them.
        size: Rows of the square matrix.
        what: Names the system in errors.
        method: ``"auto"`` takes multigrid for more than 50,000 unknowns whose couplings are
            mostly negative, as those of Laplacians are, and sparse Cholesky for the rest.
        tolerance: Of multigrid: of the error, in the energy norm, relative.

    Returns:
        What ``solve(rhs)`` is called on.

    Raises:
        SingularSystemError: See :class:`~pimper_torch.linalg.sparse.SparseCholesky` and
            :class:`~pimper_torch.linalg.multigrid.Multigrid`.
    """
    if method == "multigrid" or (
        method == "auto" and size > _CHOLESKY_UNKNOWNS and _like_a_laplacian(rows, cols, values)
    ):
        return Multigrid(rows, cols, values, size, what, tolerance)
    return SparseCholesky(rows, cols, values, size, what)


def _like_a_laplacian(
    rows: Int[Tensor, " entry"], cols: Int[Tensor, " entry"], values: Float[Tensor, " entry"]
) -> bool:
    off = values.detach()[rows != cols]
    positive = float(torch.where(off > 0, off, 0).sum())
    return positive <= _POSITIVE_SHARE * float(off.abs().sum())
