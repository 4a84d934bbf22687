"""Sparse Cholesky factors, with differentiable solves.

The only module that calls cholespy (a wrapper of CHOLMOD). Systems are factored on the CPU in
float64; solutions have the device and dtype of the right-hand side.
"""

import atexit
from weakref import WeakSet

import numpy as np
import torch
from cholespy import CholeskySolverD, MatrixType
from scipy.sparse import coo_array

from pimper_torch.linalg.prepared import WORST_RESIDUAL, PreparedMatrix, SingularSystemError
from pimper_torch.records.shapes import Unknowns

# Above this condition number the solution has fewer than three digits in float64; singular matrices
# that can be factored only because of rounding are at 1e15 and more.
_WORST_CONDITION = 1e13

# Factors to free before Python ends. A result with gradients keeps its factor in a graph of torch,
# which is not freed at exit, and cholespy prints leaks.
_ALIVE: WeakSet["SparseCholesky"] = WeakSet()


class SparseCholesky(PreparedMatrix):
    r"""Cholesky factor of a sparse symmetric positive definite matrix.

    Arguments are those of :class:`~pimper_torch.linalg.prepared.PreparedMatrix`.

    Raises:
        SingularSystemError: Also if the matrix is not symmetric positive definite, or if its
            condition number, with the diagonal scaled to 1, leaves fewer than three digits.

    >>> index = torch.tensor([0, 1])
    >>> factor = SparseCholesky(index, index, torch.tensor([2.0, 4.0]), size=2)
    >>> factor.solve(torch.tensor([1.0, 1.0]))
    tensor([0.5000, 0.2500])
    """

    def _prepare(self, tolerance: float) -> None:
        # With a unit diagonal the condition number does not depend on units.
        self._scale = self._diagonal.rsqrt()
        self._scaled = scaled = coo_array(self._matrix)
        scale, size = self._scale.numpy(), len(self._scale)
        scaled.data *= scale[scaled.row] * scale[scaled.col]
        self._solver = None
        if size:
            lower = scaled.row >= scaled.col
            parts = (part[lower] for part in (scaled.row, scaled.col, scaled.data))
            try:
                self._solver = CholeskySolverD(size, *parts, MatrixType.COO)
            except ValueError as error:
                raise SingularSystemError(
                    f"{self._what} ({size} unknowns) is not positive definite: {error} Its "
                    "equations contradict least squares or leave unknowns undetermined. Add "
                    "equations for them, or increase the weight of the prior."
                ) from error
        _ALIVE.add(self)
        # The condition number is estimated from the solution for a generic right-hand side.
        probe = torch.cos(torch.arange(size, dtype=torch.float64) ** 2)  # without structure
        growth = float(self._substitute(probe).norm() / probe.norm()) if size else 0.0
        if not growth < _WORST_CONDITION:
            raise SingularSystemError(
                f"{self._what} ({size} unknowns) has a condition number of about {growth:.0e}; "
                f"below {_WORST_CONDITION:.0e} is needed. No equation determines some of the "
                "unknowns: add equations for them, or increase the weight of the prior."
            )

    def _substitute(self, scaled_rhs: Unknowns) -> Unknowns:
        solution = np.zeros(scaled_rhs.shape)
        if solution.size and self._solver is not None:
            self._solver.solve(np.ascontiguousarray(scaled_rhs.numpy()), solution)
        return torch.from_numpy(solution)

    def solve_values(self, rhs: Unknowns) -> Unknowns:
        """Solve without gradients."""
        columns = rhs.detach().double().cpu().reshape(rhs.shape[0], -1)
        scaled = columns * self._scale[:, None]
        solution = self._substitute(scaled)
        residual = scaled - torch.from_numpy(self._scaled @ solution.numpy())
        size = scaled.norm(dim=0).clamp_min(torch.finfo(torch.float64).tiny)
        fraction = residual.norm(dim=0) / size
        if fraction.numel() and not bool((fraction < WORST_RESIDUAL).all()):
            raise SingularSystemError(
                f"the solution of {self._what} ({len(columns)} unknowns) has a residual of "
                f"{float(fraction.max()):.1e} of the right-hand side; at most {WORST_RESIDUAL:.0e} "
                "is accepted. The matrix is nearly singular or not symmetric, or the right-hand "
                "side is not finite: add equations, and look for invalid samples in the input."
            )
        return (solution * self._scale[:, None]).reshape(rhs.shape).to(rhs)


@atexit.register
def _release_factors() -> None:
    for factor in _ALIVE:
        factor._solver = None
