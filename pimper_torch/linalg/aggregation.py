r"""Prolongation of algebraic multigrid by smoothed aggregation.

Strongly connected unknowns are aggregated to one coarse unknown, and one averaging step smooths the
piecewise constant prolongation. Two rules make it robust to entries that vary by ten orders:

- Two unknowns may root an aggregate together only if their entry is large relative to the
  largest of both rows. A light unknown between two heavy ones must not connect them.
- An unknown without such an entry is assigned to the aggregate of its largest coupling. Otherwise
  it would not follow its heavy neighbour, and would increase the coarse energy.

The near-kernel need not be constant: heights along two directions, one of them nearly in the
surface, differ by a factor. So unknowns are scaled by a near-kernel vector (ones, smoothed).

On a raster with equal weights the aggregates are patches of about 3 x 3 pixels; along a strip
between two cuts they are pieces of the strip; a hole has none.

Source: Vanek, Mandel & Brezina, Computing 56, 1996, for smoothed aggregation; Bell, Dalton &
Olson, SIAM J. Sci. Comput. 34(4), 2012, for parallel aggregation; Brezina, Falgout, MacLachlan,
Manteuffel, McCormick & Ruge, SIAM J. Sci. Comput. 25(6), 2004, for the adaptive near-kernel. The
assignment of light unknowns is ours (docs/decisions.md, "Solvers of sparse systems").
"""

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array

from pimper_torch.runtime.parallel import over_rows

# An entry is strong if it is at least this fraction of the largest of its row; chosen by iterations
# on weights that vary over 0 to 10 orders, where 0.1 takes up to 1.6 times as many.
_STRONG = 0.25

# An unknown with couplings that sum to less than this fraction of its diagonal is determined by its
# own prior: smoothing alone solves for it. A choice.
_COUPLED = 0.05

# Of the step that smooths the aggregates' edges; 2/3 damps an M-matrix's highest frequencies best.
_DAMPING = 2 / 3

# Roots are chosen in random order within blocks of this size, which fit the cache: a choice.
_BLOCK = 4096


def prolongation(matrix: csr_array) -> csr_array:
    """Return the prolongation from coarse unknowns to those of ``matrix``.

    Args:
        matrix: Symmetric, with a positive diagonal; best with few positive entries off it.

    Returns:
        One column per coarse unknown, not negative. Rows of isolated unknowns are empty; the others
        sum to the near-kernel vector where the diagonal has no excess (a prior).
    """
    from pimper_torch.kernels import multigrid_levels as kernels

    parts, size = parts_of(matrix), matrix.shape[0]
    dominant, scale = dominant_diagonal(matrix), np.ones(size)
    smoother = np.empty(size)
    # Potatoes took 25 cycles without these steps, 18 with two, 17 with five and with more.
    for _ in range(5):
        over_rows(kernels.smooth_ones, size, *parts, dominant, scale, smoother, _DAMPING)
        scale, smoother = smoother, scale
    # Priors and folds could make it vanish.
    scale = np.maximum(np.abs(scale, out=scale), 0.1, out=scale)
    largest, coupled, excess = dominant, smoother, np.empty(size)  # reused memory
    over_rows(kernels.couplings, size, *parts, scale, largest, coupled, excess)
    strong, label = np.empty(len(parts[1]), np.bool_), np.empty(size, np.int32)
    connections = scale, largest, coupled
    over_rows(kernels.strong_connections, size, *parts, *connections, _STRONG, _COUPLED, strong)
    within = np.random.default_rng(0).permutation(min(size, _BLOCK))
    order = (np.arange(0, size, _BLOCK)[:, None] + within).ravel() if size else within
    count = kernels.roots(*parts[:2], strong, order[order < size], label)
    next_label = np.empty_like(label)
    for _ in range(2):
        over_rows(kernels.assigned, size, *parts, scale, strong, label, next_label)
        label, next_label = next_label, label
    while any(
        over_rows(
            kernels.assigned_by_coupling, size, *parts, *connections, _COUPLED, label, next_label
        )
    ):
        label, next_label = next_label, label
    blocks = over_rows(
        kernels.prolongation, size, *parts, scale, largest, excess, label, _STRONG, _DAMPING
    )
    return _concatenated(blocks, count)


def dominant_diagonal(matrix: csr_array) -> Float[np.ndarray, " unknown"]:
    """Return a diagonal with which Jacobi's iteration has a spectrum within [0, 2].

    It is that of the matrix in rows that are diagonally dominant.
    """
    from pimper_torch.kernels import multigrid_levels as kernels

    diagonal, dominant = np.empty((2, matrix.shape[0]))
    over_rows(kernels.diagonals, len(diagonal), *parts_of(matrix), diagonal, dominant)
    return dominant


def coarser(matrix: csr_array, prolong: csr_array, restrict: csr_array) -> csr_array:
    """Return the Galerkin matrix of the coarse unknowns."""
    from pimper_torch.kernels import multigrid_levels as kernels

    parts = [part for each in (matrix, prolong, restrict) for part in parts_of(each)]
    return _concatenated(over_rows(kernels.coarser, restrict.shape[0], *parts), restrict.shape[0])


def parts_of(matrix: csr_array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the arrays of a compressed matrix: starts of rows, columns and entries."""
    return matrix.indptr, matrix.indices, matrix.data


def _concatenated(blocks: list[tuple[np.ndarray, np.ndarray, np.ndarray]], width: int) -> csr_array:
    """Concatenate blocks of rows, each as counts of entries, columns and entries, to a matrix."""
    counts, columns, entries = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    starts = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=starts[1:])
    return csr_array((entries, columns, starts), shape=(len(counts), width))
