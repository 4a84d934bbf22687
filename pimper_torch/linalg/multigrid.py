"""Sparse solver by conjugate gradients with a multigrid preconditioner."""

import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.linalg.conjugate_gradients import compressed_gradients
from pimper_torch.linalg.hierarchy import Hierarchy, with_product
from pimper_torch.linalg.prepared import WORST_RESIDUAL, PreparedMatrix, SingularSystemError

# Iteration limit, a choice: the hardest systems of docs/decisions.md take 25.
_MAX_CYCLES = 300


def solve_by_cycles(
    matrix: csr_array,
    hierarchy: Hierarchy,
    diagonal: Float[Tensor, " unknown"],
    rhs: Float[Tensor, "unknown side"],
    tolerance: float,
    what: str,
    start: Float[Tensor, "unknown side"] | None = None,
) -> tuple[Float[Tensor, "unknown side"], int]:
    """Solve A x = b in float64 by conjugate gradients, for all right-hand sides together.

    Args:
        diagonal: Of A; only to measure the residual.
        rhs: ``b``, on the CPU.
        tolerance: Maximum energy norm of the error, as estimated by the hierarchy, relative to that
            of the solution.
        start: Initial solution; zero by default.

    Returns:
        The solution, and the number of iterations.

    Raises:
        SingularSystemError: No convergence, with the iterations and the residual reached.
    """
    solution, cycles, converged = compressed_gradients(
        matrix, hierarchy, rhs, start=start, tolerance=tolerance, max_iterations=_MAX_CYCLES
    )
    residual = with_product(matrix, solution, rhs, keep=1.0, gain=-1.0)
    scale = diagonal.rsqrt()[:, None]
    remaining, side = (scale * residual).norm(dim=0), (scale * rhs).norm(dim=0)
    # The right-hand side of a smooth solution is small compared with its energy norm.
    energy = (solution * rhs).sum(dim=0).clamp_min(0).sqrt()
    # The energy norm bounds the residual up to a factor of 1.5; the hierarchy estimates it.
    limit = torch.maximum(WORST_RESIDUAL * side, 10.0 * tolerance * energy)
    if not (converged and bool((remaining <= limit).all())):
        raise SingularSystemError(
            f"{what} ({len(rhs)} unknowns) did not converge: after {cycles} iterations of "
            f"multigrid its residual is {float((remaining / limit).max()):.1e} times the accepted "
            f"one, with a relative tolerance of {tolerance:.0e}. (Nearly) no equation determines "
            "some of the unknowns, or the matrix is not positive definite: add equations, "
            "increase the weight of the prior, or solve by Cholesky."
        )
    return solution, cycles


class Multigrid(PreparedMatrix):
    r"""Sparse matrix solved by conjugate gradients with a multigrid preconditioner.

    For millions of unknowns: memory and time are linear in the unknowns, unlike those of
    :class:`~pimper_torch.linalg.sparse.SparseCholesky`. For matrices with mostly negative
    off-diagonal entries, such as graph Laplacians. Cycles run on the CPU.

    >>> index = torch.tensor([0, 1])
    >>> grid = Multigrid(index, index, torch.tensor([2.0, 4.0]), size=2)
    >>> grid.solve(torch.tensor([1.0, 1.0]))
    tensor([0.5000, 0.2500])
    """

    def _prepare(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._hierarchy = Hierarchy(self._matrix)

    def iterate(
        self, rhs: Float[Tensor, "unknown ..."]
    ) -> tuple[Float[Tensor, "unknown ..."], int]:
        """Return the solution and the number of iterations; float64 on the CPU, no gradients."""
        columns = rhs.detach().cpu().double().reshape(len(rhs), -1).contiguous()
        system = self._matrix, self._hierarchy, self._diagonal, columns
        solution, cycles = solve_by_cycles(*system, self._tolerance, self._what)
        return solution.reshape(rhs.shape), cycles

    def solve_values(self, rhs: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        """Solve without gradients."""
        return rhs.clone() if rhs.numel() == 0 else self.iterate(rhs)[0].to(rhs)
