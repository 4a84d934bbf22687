"""Sparse Cholesky factors, with differentiable solves.

The one place that talks to cholespy (CHOLMOD underneath). Systems are factored on the CPU
in float64 whatever the device and dtype of the tensors; solutions go back to both.
"""

import atexit
from weakref import WeakSet

import numpy as np
import torch
from cholespy import CholeskySolverD, MatrixType
from scipy.sparse import coo_array

from pimper_torch.ground.linalg.prepared import WORST_RESIDUAL, PreparedMatrix, SingularSystemError
from pimper_torch.ground.shapes import Unknowns

# Above this the solution has fewer than three digits in float64; an exactly singular
# matrix that survives elimination by rounding lands at 1e15 and more.
_WORST_CONDITION = 1e13

# Factors whose CHOLMOD part is still to be let go of when Python ends. A result with gradients
# holds its factor in a graph of torch, which then frees nothing, and cholespy prints what leaks.
_ALIVE: WeakSet["SparseCholesky"] = WeakSet()


class SparseCholesky(PreparedMatrix):
    r"""A factored matrix.

    Arguments are those of :class:`~pimper_torch.ground.linalg.prepared.PreparedMatrix`.

    Raises:
        SingularSystemError: Also for a matrix that is not symmetric positive definite, or one
            whose condition (after scaling the diagonal to 1) leaves fewer than three digits.

    >>> index = torch.tensor([0, 1])
    >>> factor = SparseCholesky(index, index, torch.tensor([2.0, 4.0]), size=2)
    >>> factor.solve(torch.tensor([1.0, 1.0]))
    tensor([0.5000, 0.2500])
    """

    def _prepare(self, tolerance: float) -> None:
        # A unit diagonal makes the condition a property of the problem, not of its units.
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
                    "equations contradict least squares or leave unknowns free. Anchor the "
                    "unknowns, or raise the weight of the prior."
                ) from error
        _ALIVE.add(self)
        # The condition is estimated from the solution for a generic right-hand side.
        probe = torch.cos(torch.arange(size, dtype=torch.float64) ** 2)  # no structure to fit
        growth = float(self._substitute(probe).norm() / probe.norm()) if size else 0.0
        if not growth < _WORST_CONDITION:
            raise SingularSystemError(
                f"{self._what} ({size} unknowns) has a condition number of about {growth:.0e}; "
                f"below {_WORST_CONDITION:.0e} is needed. Some unknowns are determined by no "
                "equation: anchor them, or raise the weight of the prior."
            )

    def _substitute(self, scaled_rhs: Unknowns) -> Unknowns:
        answer = np.zeros(scaled_rhs.shape)
        if answer.size and self._solver is not None:
            self._solver.solve(np.ascontiguousarray(scaled_rhs.numpy()), answer)
        return torch.from_numpy(answer)

    def solve_values(self, rhs: Unknowns) -> Unknowns:
        """Solve; constant to autograd."""
        columns = rhs.detach().double().cpu().reshape(rhs.shape[0], -1)
        scaled = columns * self._scale[:, None]
        answer = self._substitute(scaled)
        residual = scaled - torch.from_numpy(self._scaled @ answer.numpy())
        size = scaled.norm(dim=0).clamp_min(torch.finfo(torch.float64).tiny)
        fraction = residual.norm(dim=0) / size
        if fraction.numel() and not bool((fraction < WORST_RESIDUAL).all()):
            raise SingularSystemError(
                f"the solution of {self._what} ({len(columns)} unknowns) misses its right-hand "
                f"side by {float(fraction.max()):.1e} of its size; {WORST_RESIDUAL:.0e} is needed. "
                "The matrix is nearly singular or not symmetric, or the right-hand side is not "
                "finite: anchor the unknowns, and look for invalid samples in the input."
            )
        return (answer * self._scale[:, None]).reshape(rhs.shape).to(rhs)


@atexit.register
def _release_factors() -> None:
    for factor in _ALIVE:
        factor._solver = None
