"""Base class of sparse solvers: assembly of the matrix, and gradients of solutions."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from torch import Tensor

from pimper_torch.records.shapes import PerEntry, Unknowns
from pimper_torch.runtime.errors import NumericalError

# Maximum residual of a solution relative to the right-hand side, with the diagonal scaled to 1: a
# choice, far above rounding and far below noise of the data.
WORST_RESIDUAL = 1e-6


class SingularSystemError(NumericalError):
    """Linear equations that do not determine their unknowns."""


def require_solvable(entries: PerEntry, diagonal: Float[Tensor, " unknown"], what: str) -> None:
    """Raise SingularSystemError for entries that are not finite or a diagonal not positive."""
    if not bool(entries.isfinite().all()):
        raise SingularSystemError(
            f"{what} has {int((~entries.isfinite()).sum())} entries that are not finite; all must "
            "be finite numbers. Look for zero weights or invalid samples in its input."
        )
    empty = torch.nonzero(diagonal <= 0).flatten()
    if len(empty):
        raise SingularSystemError(
            f"{what} leaves {len(empty)} of {len(diagonal)} unknowns without a positive "
            f"diagonal (the first is unknown {int(empty[0])}); each needs at least one equation "
            "with positive weight. Add data or a prior for them."
        )


# Energy norm of the error over that of the solution: a choice; a digit costs one to two cycles.
DEFAULT_TOLERANCE = 1e-10


class PreparedMatrix(ABC):
    r"""A sparse symmetric positive definite matrix, prepared for any number of right-hand sides.

    :math:`A_{ij} = \sum_{k: (r_k, c_k) = (i, j)} v_k`: duplicate entries add up. Both triangles
    must be given.

    Args:
        values: Of the entries; solutions are differentiable in them.
        what: Name of the system in errors, such as ``"the alignment"``.
        tolerance: Maximum relative error in the energy norm; ignored by a Cholesky factor.

    Raises:
        SingularSystemError: Entries that are not finite, or a diagonal that is not positive.
    """

    def __init__(
        self,
        rows: Int[Tensor, " entry"],
        cols: Int[Tensor, " entry"],
        values: PerEntry,
        size: int,
        what: str = "the linear system",
        tolerance: float = DEFAULT_TOLERANCE,
    ) -> None:
        index = tuple(part.cpu().numpy().astype(np.int32) for part in (rows, cols))
        entries = values.detach().double().cpu().numpy()
        self._matrix = coo_array((entries, index), shape=(size, size)).tocsr()
        self._diagonal = torch.from_numpy(self._matrix.diagonal())
        require_solvable(torch.from_numpy(self._matrix.data), self._diagonal, what)
        if not values.requires_grad:  # only gradients need the entries
            rows, cols, values = (part.new_empty(0) for part in (rows, cols, values))
        self.rows, self.cols, self._values, self._what = rows, cols, values, what
        self._prepare(tolerance)

    @abstractmethod
    def _prepare(self, tolerance: float) -> None: ...

    def solve(self, rhs: Unknowns) -> Unknowns:
        """Solve for one or more right-hand sides.

        Differentiable in ``rhs`` and in the matrix's ``values``, any number of times, by adjoint
        solves with the same preparation. The gradient by ``values`` treats all entries as
        independent; through a symmetric assembly it is exact.

        Raises:
            SingularSystemError: Residual above 1e-6 of the right-hand side, or that is not finite.
        """
        solution: Tensor = _Solve.apply(self, self._values, rhs)  # type: ignore[no-untyped-call]
        return solution

    @abstractmethod
    def solve_values(self, rhs: Unknowns) -> Unknowns:
        """Solve without gradients, in device and dtype of ``rhs``; raises as :meth:`solve`."""


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, prepared: PreparedMatrix, values: PerEntry, rhs: Unknowns) -> Unknowns:
        solution = prepared.solve_values(rhs.detach())
        ctx.prepared = prepared
        ctx.save_for_backward(values, solution)
        return solution

    @staticmethod
    def backward(ctx: Any, upstream: Unknowns) -> tuple[None, PerEntry | None, Unknowns]:
        values, solution = ctx.saved_tensors
        prepared: PreparedMatrix = ctx.prepared
        adjoint: Tensor = _Solve.apply(prepared, values, upstream)  # type: ignore[no-untyped-call]
        into_values = None
        if ctx.needs_input_grad[1]:
            products = adjoint[prepared.rows] * solution[prepared.cols]
            into_values = -products.reshape(len(values), -1).sum(dim=1).to(values)
        return None, into_values, adjoint
