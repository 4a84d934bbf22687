"""Conjugate gradients preconditioned by multigrid, with the interface of sparse Cholesky."""

import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.ground.linalg.conjugate_gradients import compressed_gradients
from pimper_torch.ground.linalg.hierarchy import Hierarchy, with_product
from pimper_torch.ground.linalg.prepared import WORST_RESIDUAL, PreparedMatrix, SingularSystemError

# A choice: the hardest systems of `benchmarks/linear_systems.py` take 25 cycles.
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
    """Solve A x = b in float64 by conjugate gradients, for all right-hand sides at once.

    Args:
        diagonal: Of A; only to measure the residual.
        rhs: ``b``, on the CPU.
        tolerance: Of the error's energy norm, as the hierarchy estimates it, relative to that of
            the solution.
        start: Where to begin; zero if not given.

    Returns:
        The solution, and the number of iterations.

    Raises:
        SingularSystemError: No convergence, with the iterations and the residual reached.
    """
    found, cycles, converged = compressed_gradients(
        matrix, hierarchy, rhs, start=start, tolerance=tolerance, max_iterations=_MAX_CYCLES
    )
    residual = with_product(matrix, found, rhs, keep=1.0, gain=-1.0)
    scale = diagonal.rsqrt()[:, None]
    left, side = (scale * residual).norm(dim=0), (scale * rhs).norm(dim=0)
    # Smooth solutions have a right-hand side that is small compared with their energy norm.
    energy = (found * rhs).sum(dim=0).clamp_min(0).sqrt()
    # The energy norm bounds the residual but for a factor of 1.5; the hierarchy estimates it.
    most = torch.maximum(WORST_RESIDUAL * side, 10.0 * tolerance * energy)
    if not (converged and bool((left <= most).all())):
        raise SingularSystemError(
            f"{what} ({len(rhs)} unknowns) did not converge: after {cycles} iterations of "
            f"multigrid its residual is {float((left / most).max()):.1e} of the largest that is "
            f"accepted, and its relative error must be {tolerance:.0e}. Some "
            "unknowns are determined by (nearly) no equation, or the matrix is not positive "
            "definite: anchor them, raise the weight of the prior, or solve by Cholesky."
        )
    return found, cycles


class Multigrid(PreparedMatrix):
    r"""Solves a sparse system by conjugate gradients with a multigrid preconditioner.

    For millions of unknowns: memory and time are linear in the unknowns, unlike those of
    :class:`~pimper_torch.ground.linalg.sparse.SparseCholesky`. For graph Laplacians and similar
    matrices, whose off-diagonal entries are mostly negative. Cycles run on the CPU, wherever the
    right-hand side is.

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
        """Solve and count the iterations; not differentiable, in float64 on the CPU."""
        columns = rhs.detach().cpu().double().reshape(len(rhs), -1).contiguous()
        given = self._matrix, self._hierarchy, self._diagonal, columns
        found, cycles = solve_by_cycles(*given, self._tolerance, self._what)
        return found.reshape(rhs.shape), cycles

    def solve_values(self, rhs: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        """Solve; constant to autograd."""
        return rhs.clone() if rhs.numel() == 0 else self.iterate(rhs)[0].to(rhs)
