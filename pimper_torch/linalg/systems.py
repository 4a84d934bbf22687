"""Solution of sparse systems by Cholesky or multigrid, depending on their size."""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.linalg.aggregation import parts_of
from pimper_torch.linalg.hierarchy import Hierarchy
from pimper_torch.linalg.multigrid import Multigrid, solve_by_cycles
from pimper_torch.linalg.prepared import (
    DEFAULT_TOLERANCE,
    SingularSystemError,
    require_solvable,
)
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.linalg.sums import total
from pimper_torch.runtime.failures import skipped_solver
from pimper_torch.runtime.parallel import over_rows

# At this size a Cholesky factor takes three times as long to compute as a hierarchy, and a third as
# long to use. It is exact, and the solves for three coordinates make up for half a second.
_CHOLESKY_UNKNOWNS = 50_000

# With compiled kernels, a hierarchy is faster from this size: the fusion in the demo's second
# iteration, 34,000 and 137,000 unknowns, takes 6.1 s instead of 7.3.
_COMPILED_CHOLESKY_UNKNOWNS = 10_000

# Maximum fraction of positive entries off the diagonal for multigrid: a choice.
_POSITIVE_FRACTION = 0.1


def prepare_system(
    rows: Int[Tensor, " entry"],
    cols: Int[Tensor, " entry"],
    values: Float[Tensor, " entry"],
    size: int,
    what: str = "the linear system",
    *,
    tolerance: float = DEFAULT_TOLERANCE,
) -> SparseCholesky | Multigrid:
    """Prepare a sparse symmetric positive definite matrix for any number of solves.

    Multigrid is used for more than 50,000 unknowns with mostly negative couplings, as in
    Laplacians, and sparse Cholesky otherwise.

    Args:
        rows: Row of each entry; duplicate entries add up.
        values: Of the entries; solutions are differentiable in them.
        tolerance: Of multigrid: maximum relative error in the energy norm.

    Raises:
        SingularSystemError: See :class:`~pimper_torch.linalg.sparse.SparseCholesky` and
            :class:`~pimper_torch.linalg.multigrid.Multigrid`.
    """
    if size > _CHOLESKY_UNKNOWNS:
        off = values.detach()[rows != cols]
        positive = float(total(torch.where(off > 0, off, 0)))
        if positive <= _POSITIVE_FRACTION * float(total(off.abs())):
            return Multigrid(rows, cols, values, size, what, tolerance)
    return SparseCholesky(rows, cols, values, size, what)


def solutions(
    rows: Int[Tensor, " entry"],
    cols: Int[Tensor, " entry"],
    values: Float[Tensor, " entry"],
    *sides: Float[Tensor, "unknown ..."],
    what: str = "the linear system",
    tolerance: float = DEFAULT_TOLERANCE,
) -> tuple[Float[Tensor, "unknown ..."], ...]:
    """Solve for several right-hand sides, by Cholesky if multigrid does not converge.

    Slivers among the faces of a mesh, and weights that differ by a factor of a million between
    neighbours, may slow multigrid down. Differentiable in ``values`` and in the sides.
    """
    size = len(sides[0])
    prepared = prepare_system(rows, cols, values, size, what, tolerance=tolerance)
    try:
        return tuple(prepared.solve(side) for side in sides)
    except SingularSystemError as error:
        if isinstance(prepared, SparseCholesky):
            raise
        _report_fallback(what, error)
    factor = SparseCholesky(rows, cols, values, size, what)
    return tuple(factor.solve(side) for side in sides)


def solve_compressed(
    matrix: csr_array,
    sides: Float[Tensor, "unknown side"],
    *,
    what: str,
    tolerance: float = DEFAULT_TOLERANCE,
    start: Float[Tensor, "unknown side"] | None = None,
) -> Float[Tensor, "unknown side"]:
    """Solve as :func:`solutions`, for a matrix in compressed rows, without gradients.

    Args:
        start: Initial solution of multigrid; zero by default.
    """
    from pimper_torch.kernels import multigrid_levels as kernels

    diagonal = torch.from_numpy(matrix.diagonal())
    if len(sides) > _COMPILED_CHOLESKY_UNKNOWNS:
        parts = over_rows(kernels.off_diagonal, len(sides), *parts_of(matrix))
        positive, total = (sum(part) for part in zip(*parts, strict=True))
        if positive <= _POSITIVE_FRACTION * total:
            require_solvable(torch.from_numpy(matrix.data), diagonal, what)
            try:
                system = matrix, Hierarchy(matrix, torch.float32), diagonal, sides
                return solve_by_cycles(*system, tolerance, what, start)[0]
            except SingularSystemError as error:
                _report_fallback(what, error)
    rows = np.repeat(np.arange(len(sides)), np.diff(matrix.indptr))
    index = torch.from_numpy(rows), torch.from_numpy(matrix.indices).long()
    return SparseCholesky(*index, torch.from_numpy(matrix.data), len(sides), what).solve(sides)


def _report_fallback(what: str, error: SingularSystemError) -> None:
    done = "It is solved by a Cholesky factor instead, which takes more time and memory"
    skipped_solver("linalg", what, error, done)
