"""Sparse symmetric positive definite systems: assembly from blocks, differentiable solves.

The one place that talks to cholespy (CHOLMOD underneath). Systems are factored on the CPU
in float64 whatever the device and dtype of the tensors; solutions go back to both.
"""

import numpy as np
import torch
from cholespy import CholeskySolverD, MatrixType
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.linalg.adjoint import solve_adjointly
from pimper_torch.linalg.singular import SingularSystemError, refuse_hopeless

# Above this the solution has fewer than three digits in float64; an exactly singular
# matrix that survives elimination by rounding lands at 1e15 and more.
_WORST_CONDITION = 1e13


class SparseCholesky:
    r"""A factored matrix, ready for any number of right-hand sides.

    :math:`A_{ij} = \sum_{k: (r_k, c_k) = (i, j)} v_k`: entries named twice add up, as they do
    when normal equations are collected term by term. Both triangles must be given.

    Args:
        rows: Row of each entry.
        cols: Column of each entry.
        values: Of the entries; solutions are differentiable in them.
        size: Rows of the square matrix.
        what: Names the system in errors, such as ``"the alignment"``.

    Raises:
        SingularSystemError: Entries that are not finite, an unknown without a positive
            diagonal, a matrix that is not symmetric positive definite, or one whose
            condition (after scaling the diagonal to 1) leaves fewer than three digits.

    >>> index = torch.tensor([0, 1])
    >>> factor = SparseCholesky(index, index, torch.tensor([2.0, 4.0]), size=2)
    >>> factor.solve(torch.tensor([1.0, 1.0]))
    tensor([0.5000, 0.2500])
    """

    def __init__(
        self,
        rows: Int[Tensor, " entry"],
        cols: Int[Tensor, " entry"],
        values: Float[Tensor, " entry"],
        size: int,
        what: str = "the linear system",
    ) -> None:
        self.rows, self.cols, self._values, self._what = rows, cols, values, what
        with torch.no_grad():
            matrix = torch.sparse_coo_tensor(
                torch.stack([rows, cols]).cpu(),
                values.double().cpu(),
                (size, size),
                check_invariants=True,
            ).coalesce()
            index, entries = matrix.indices(), matrix.values()
            diagonal = torch.zeros(size, dtype=torch.float64)
            on = index[0] == index[1]
            diagonal[index[0, on]] = entries[on]
            refuse_hopeless(entries, diagonal, what)
            # A unit diagonal makes the condition a property of the problem, not of its units.
            self._scale = diagonal.rsqrt()
            entries = entries * self._scale[index[0]] * self._scale[index[1]]
            self._scaled = torch.sparse_coo_tensor(
                index, entries, (size, size), is_coalesced=True, check_invariants=False
            )
            self._solver = self._factor(index, entries, size)
            self._probe(size)

    def solve(self, rhs: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        """Solve for one right-hand side or several.

        Differentiable in ``rhs`` and in the matrix's ``values``, any number of times, by
        adjoint solves with the same factor. A gradient with respect to ``values`` treats the
        entries as free; used through a symmetric assembly it is exact.

        Raises:
            SingularSystemError: The solution does not satisfy the equations to 1e-6 of the
                right-hand side, or the right-hand side is not finite.
        """
        return solve_adjointly(self, self._values, rhs)

    def _factor(
        self, index: Int[Tensor, "2 entry"], entries: Float[Tensor, " entry"], size: int
    ) -> CholeskySolverD | None:
        if size == 0:
            return None
        lower = index[0] >= index[1]
        rows, cols = index[:, lower].int().numpy()
        try:
            return CholeskySolverD(size, rows, cols, entries[lower].numpy(), MatrixType.COO)
        except ValueError as error:
            raise SingularSystemError(
                f"{self._what} ({size} unknowns) is not positive definite: {error} Its "
                "equations contradict least squares or leave unknowns free. Anchor the "
                "unknowns, or raise the weight of the prior."
            ) from error

    def _probe(self, size: int) -> None:
        """Estimate the condition from the answer to a generic right-hand side."""
        probe = torch.cos(torch.arange(size, dtype=torch.float64) ** 2)  # no structure to fit
        answer = self._substitute(probe)
        growth = float(answer.norm() / probe.norm()) if size else 0.0
        if not growth < _WORST_CONDITION:
            raise SingularSystemError(
                f"{self._what} ({size} unknowns) has a condition number of about {growth:.0e}; "
                f"below {_WORST_CONDITION:.0e} is needed. Some unknowns are determined by no "
                "equation: anchor them, or raise the weight of the prior."
            )

    def _substitute(self, scaled_rhs: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        answer = np.zeros(scaled_rhs.shape)
        if answer.size and self._solver is not None:
            self._solver.solve(np.ascontiguousarray(scaled_rhs.numpy()), answer)
        return torch.from_numpy(answer)

    def solve_values(self, rhs: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        """Solve without a trace for autograd; the same errors."""
        columns = rhs.detach().double().cpu().reshape(rhs.shape[0], -1)
        scaled = columns * self._scale[:, None]
        answer = self._substitute(scaled)
        misfit = (scaled - self._scaled @ answer).norm(dim=0)
        fraction = misfit / scaled.norm(dim=0).clamp_min(torch.finfo(torch.float64).tiny)
        if fraction.numel() and not bool((fraction < 1e-6).all()):
            raise SingularSystemError(
                f"the solution of {self._what} ({len(columns)} unknowns) misses its right-hand "
                f"side by {float(fraction.max()):.1e} of its size; 1e-06 is needed. The matrix is "
                "nearly singular or not symmetric, or the right-hand side is not finite: anchor "
                "the unknowns, and look for invalid samples in the input."
            )
        return (answer * self._scale[:, None]).reshape(rhs.shape).to(rhs)


def solve_spd(
    rows: Int[Tensor, " entry"],
    cols: Int[Tensor, " entry"],
    values: Float[Tensor, " entry"],
    rhs: Float[Tensor, "unknown ..."],
    what: str = "the linear system",
) -> Float[Tensor, "unknown ..."]:
    """Solve one sparse symmetric positive definite system; see :class:`SparseCholesky`."""
    return SparseCholesky(rows, cols, values, size=rhs.shape[0], what=what).solve(rhs)


def scatter_blocks(
    block_rows: Int[Tensor, " block"],
    block_cols: Int[Tensor, " block"],
    blocks: Float[Tensor, "block unknown unknown"],
) -> tuple[Int[Tensor, " entry"], Int[Tensor, " entry"], Float[Tensor, " entry"]]:
    """Spread small dense blocks into the entries of a sparse matrix.

    Args:
        block_rows: Which block row each block stands in.
        block_cols: Which block column.
        blocks: Square, all of one size.

    Returns:
        Rows, columns and values for :class:`SparseCholesky`; duplicates are left to it.
    """
    side = blocks.shape[-1]
    within = torch.arange(side, device=blocks.device)
    rows = (side * block_rows[:, None, None] + within[:, None]).expand(blocks.shape)
    cols = (side * block_cols[:, None, None] + within).expand(blocks.shape)
    return rows.reshape(-1), cols.reshape(-1), blocks.reshape(-1)
