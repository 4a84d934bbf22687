"""Conjugate gradients preconditioned by multigrid, with the interface of sparse Cholesky."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.linalg.conjugate_gradients import compressed_gradients, conjugate_gradients
from pimper_torch.linalg.hierarchy import (
    Hierarchy,
    Product,
    sparse_product,
    with_product,
)
from pimper_torch.linalg.prepared import PreparedMatrix
from pimper_torch.linalg.singular import WORST_RESIDUAL, SingularSystemError

# Of the error's energy norm next to the solution's. A digit costs one to two cycles.
DEFAULT_TOLERANCE = 1e-10

# The hardest systems of the benchmark take 25 cycles.
_MAX_CYCLES = 300

# Residual, in tolerances, that is accepted where a larger error was asked for: a choice, as the
# hierarchy only estimates the energy norm that the tolerance bounds.
_RESIDUAL_TOLERANCES = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Iterate:
    """A solution and how it was reached.

    Attributes:
        values: The solution, float64; one column a right-hand side where there are several.
        iterations: Cycles taken.
        residual: With the diagonal scaled to 1, next to the right-hand side; the worst of them.
    """

    values: Float[Tensor, "unknown ..."]
    iterations: int
    residual: float


def solve_with_hierarchy(
    product: Product,
    hierarchy: Hierarchy,
    diagonal: Float[Tensor, " unknown"],
    rhs: Float[Tensor, "unknown ..."],
    tolerance: float,
    what: str,
    start: Float[Tensor, "unknown ..."] | None = None,
) -> Iterate:
    """Solve A x = b in float64 by conjugate gradients, for all right-hand sides at once.

    Args:
        product: Of A.
        hierarchy: Approximates the inverse of A.
        diagonal: Of A; only to measure the residual.
        rhs: ``b``, one column a right-hand side if there are several.
        tolerance: Of the error's energy norm, as the hierarchy estimates it, next to that of
            the solution.
        what: Names the system in errors.
        start: Where to begin; zero if not given.

    Raises:
        SingularSystemError: No convergence, with the iterations and the residual reached.
    """
    found, cycles, converged = conjugate_gradients(
        product,
        hierarchy.precondition,
        rhs,
        start=start,
        dims=(0,),
        tolerance=tolerance,
        max_iterations=_MAX_CYCLES,
    )
    reached = found, cycles, converged
    return _checked(reached, rhs - product(found), diagonal, rhs, tolerance, what)


def solve_by_cycles(
    matrix: csr_array,
    diagonal: Float[Tensor, " unknown"],
    rhs: Float[Tensor, "unknown side"],
    tolerance: float,
    what: str,
    start: Float[Tensor, "unknown side"] | None = None,
) -> Iterate:
    """Do the same for a matrix in compressed rows by kernels on the CPU, its hierarchy in float32.

    Args:
        matrix: A, float64, both triangles.
        diagonal: Of A.
        rhs: As there.
        tolerance: As there.
        what: As there.
        start: As there.

    Raises:
        SingularSystemError: As there.
    """
    half = torch.float32
    reached = compressed_gradients(
        matrix,
        Hierarchy(matrix, rhs.device, dtype=half).cycle,
        rhs,
        start=start,
        tolerance=tolerance,
        max_iterations=_MAX_CYCLES,
        dtype=half,
    )
    residual = with_product(matrix, reached[0], rhs, keep=1.0, gain=-1.0)
    return _checked(reached, residual, diagonal, rhs, tolerance, what)


def _checked(
    reached: tuple[Float[Tensor, "unknown ..."], int, bool],
    residual: Float[Tensor, "unknown ..."],
    diagonal: Float[Tensor, " unknown"],
    rhs: Float[Tensor, "unknown ..."],
    tolerance: float,
    what: str,
) -> Iterate:
    """Refuse what conjugate gradients have reached if it is no solution.

    Args:
        reached: What they gave: values, steps and whether they converged.
        residual: Of the values.
        diagonal: Of the matrix.
        rhs: Right-hand side.
        tolerance: That was asked for.
        what: Names the system.

    Raises:
        SingularSystemError: No convergence, with the iterations and the residual reached.
    """
    found, cycles, converged = reached
    scale = diagonal.rsqrt().reshape(-1, *[1] * (rhs.ndim - 1))
    size = (scale * rhs).norm(dim=0)
    fraction = float(((scale * residual).norm(dim=0) / torch.where(size > 0, size, 1)).max())
    worst = max(WORST_RESIDUAL, _RESIDUAL_TOLERANCES * tolerance)
    if not (fraction < worst and converged):
        raise SingularSystemError(
            f"{what} ({len(rhs)} unknowns) did not converge: after {cycles} iterations of "
            f"multigrid its residual is {fraction:.1e} of the right-hand side; "
            f"{worst:.0e} and a relative error of {tolerance:.0e} are needed. Some "
            "unknowns are determined by (nearly) no equation, or the matrix is not positive "
            "definite: anchor them, raise the weight of the prior, or solve by Cholesky."
        )
    return Iterate(values=found, iterations=cycles, residual=fraction)


class Multigrid(PreparedMatrix):
    r"""A hierarchy for a sparse matrix; arguments as for its base, and the tolerance.

    What :class:`~pimper_torch.linalg.sparse.SparseCholesky` is for some 100,000 unknowns on
    the CPU, this is for millions, and on CUDA: memory and time grow with the unknowns only.
    Made for graph Laplacians and their like, whose off-diagonal entries are mostly negative.

    Args:
        rows: See :class:`~pimper_torch.linalg.prepared.PreparedMatrix`.
        cols: The same.
        values: The same.
        size: The same.
        what: The same.
        tolerance: Of the error, in the energy norm, relative.

    >>> index = torch.tensor([0, 1])
    >>> grid = Multigrid(index, index, torch.tensor([2.0, 4.0]), size=2)
    >>> grid.solve(torch.tensor([1.0, 1.0]))
    tensor([0.5000, 0.2500])
    """

    def __init__(
        self,
        rows: Int[Tensor, " entry"],
        cols: Int[Tensor, " entry"],
        values: Float[Tensor, " entry"],
        size: int,
        what: str = "the linear system",
        tolerance: float = DEFAULT_TOLERANCE,
    ) -> None:
        super().__init__(rows, cols, values, size, what)
        self._tolerance = tolerance
        self._diagonal = self._diagonal.to(values.device)
        self._product = sparse_product(self._matrix, values.device)
        self._hierarchy = Hierarchy(self._matrix, values.device)

    def iterate(self, rhs: Float[Tensor, "unknown ..."]) -> Iterate:
        """Solve and report the iterations; not differentiable."""
        with torch.no_grad():
            return solve_with_hierarchy(
                self._product,
                self._hierarchy,
                self._diagonal,
                rhs.detach().to(self._diagonal),
                self._tolerance,
                self._what,
            )

    def solve_values(self, rhs: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        """Solve without a trace for autograd."""
        if rhs.numel() == 0:
            return rhs.clone()
        columns = rhs if rhs.ndim == 1 else rhs.reshape(len(rhs), -1)
        return self.iterate(columns).values.reshape(rhs.shape).to(rhs)
