r"""Prolongation of algebraic multigrid by smoothed aggregation.

Strongly connected unknowns are aggregated to one coarse unknown, and one averaging step smooths
the piecewise constant prolongation. Two rules make it robust where entries vary by ten orders:

- Two unknowns may root an aggregate together only if their entry is large relative to the
  largest of both rows. A light unknown between two heavy ones must not connect them.
- An unknown without such an entry is assigned to the aggregate of its largest coupling. Left out
  instead, it would stay behind when its heavy neighbour moves, and add to the coarse energy.

The near-kernel need not be constant: heights along two directions, one of them nearly in the
surface, differ by a factor. So unknowns are scaled by a near-kernel vector (ones, smoothed).

On a raster with equal weights the aggregates are patches of about 3 x 3 pixels; along a
strip between two cuts they are pieces of the strip; a hole has none.

Source: Vanek, Mandel & Brezina, Computing 56, 1996, for smoothed aggregation; Bell, Dalton &
Olson, SIAM J. Sci. Comput. 34(4), 2012, for parallel aggregation; Brezina, Falgout, MacLachlan,
Manteuffel, McCormick & Ruge, SIAM J. Sci. Comput. 25(6), 2004, for the adaptive near-kernel. The
assignment of light unknowns is ours, measured in ``benchmarks/linear_systems.py``.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array, diags_array

from pimper_torch.kernels.switch import compiled_for
from pimper_torch.parallel import over_rows

# An entry is strong if it is at least this fraction of the largest of a row; compared by
# iterations on weights that vary over 0 to 10 orders, where 0.1 takes up to 1.6 times as many.
_STRONG = 0.25

# An unknown whose couplings add up to less than this fraction of its diagonal is determined by its
# own anchor: smoothing alone solves for it. A choice.
_COUPLED = 0.05

# Smoothing steps from ones to the near-kernel vector. The fusion of potatoes took 25 cycles
# without, 18 with two, 17 with five and with more.
_KERNEL_STEPS = 5

# Lower bound of that vector, which an anchor or a fold would make vanish: a choice.
_MIN_KERNEL = 0.1

# Of the averaging step that smooths the aggregates' edges; 2/3 damps the highest frequencies
# of an M-matrix best.
_DAMPING = 2 / 3

# Roots are chosen in blocks of so many unknowns, in random order within each: a choice, a block
# and its neighbours fit the cache.
_BLOCK = 4096


def prolongation(matrix: csr_array) -> csr_array:
    """Return the prolongation from coarse unknowns to those of ``matrix``.

    Args:
        matrix: Symmetric, its diagonal positive; best with few positive entries off it.

    Returns:
        One column per coarse unknown, not negative. Rows of isolated unknowns are empty; the
        others add up to the near-kernel vector where there is no anchor (excess of the diagonal).
    """
    if compiled_for():
        return _compiled(matrix)
    scale = diags_array(_near_kernel(matrix))
    found: csr_array = (scale @ _averaged((scale @ matrix @ scale).tocsr())).tocsr()
    return found


def dominant_diagonal(matrix: csr_array) -> Float[np.ndarray, " unknown"]:
    """Return a diagonal with which Jacobi's iteration has a spectrum within [0, 2].

    It is the matrix's own wherever that is diagonally dominant.
    """
    if compiled_for():
        from pimper_torch.kernels import aggregation as kernels

        own, dominant = np.empty((2, matrix.shape[0]))
        over_rows(kernels.diagonals, len(own), *parts_of(matrix), own, dominant)
        return dominant
    diagonal: np.ndarray = matrix.diagonal()
    return np.maximum(diagonal, abs(matrix).sum(axis=1) / 2)


def _compiled(matrix: csr_array) -> csr_array:
    """Return the prolongation by compiled kernels."""
    from pimper_torch.kernels import aggregation as kernels

    parts, size = parts_of(matrix), matrix.shape[0]
    dominant, scale = dominant_diagonal(matrix), np.ones(size)
    smoother = np.empty(size)
    for _ in range(_KERNEL_STEPS):
        over_rows(kernels.smooth_ones, size, *parts, dominant, scale, smoother, _DAMPING)
        scale, smoother = smoother, scale
    scale = np.maximum(np.abs(scale, out=scale), _MIN_KERNEL, out=scale)
    largest, coupled, excess = dominant, smoother, np.empty(size)  # reused memory
    over_rows(kernels.couplings, size, *parts, scale, largest, coupled, excess)
    strong, label = np.empty(len(parts[1]), np.bool_), np.empty(size, np.int32)
    connections = scale, largest, coupled
    over_rows(kernels.strong_connections, size, *parts, *connections, _STRONG, _COUPLED, strong)
    count = kernels.roots(*parts[:2], strong, _order(size), label)
    other = np.empty_like(label)
    for _ in range(2):
        over_rows(kernels.assigned, size, *parts, scale, strong, label, other)
        label, other = other, label
    while any(
        over_rows(kernels.assigned_by_coupling, size, *parts, *connections, _COUPLED, label, other)
    ):
        label, other = other, label
    found = over_rows(
        kernels.prolongation, size, *parts, scale, largest, excess, label, _STRONG, _DAMPING
    )
    return _concatenated(found, count)


def coarser(matrix: csr_array, prolong: csr_array, restrict: csr_array) -> csr_array:
    """Return the Galerkin matrix of the coarse unknowns.

    Args:
        prolong: From :func:`prolongation`.
    """
    if compiled_for():
        from pimper_torch.kernels import aggregation as kernels

        parts = [part for each in (matrix, prolong, restrict) for part in parts_of(each)]
        return _concatenated(
            over_rows(kernels.coarser, restrict.shape[0], *parts), restrict.shape[0]
        )
    found: csr_array = restrict @ (matrix @ prolong)
    return found


def parts_of(matrix: csr_array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the arrays of a compressed matrix: starts of rows, columns and entries."""
    return matrix.indptr, matrix.indices, matrix.data


def _concatenated(found: list[tuple[np.ndarray, np.ndarray, np.ndarray]], width: int) -> csr_array:
    """Concatenate blocks of rows, each as counts of entries, columns and entries, to a matrix."""
    counts, columns, entries = (np.concatenate(parts) for parts in zip(*found, strict=True))
    starts = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=starts[1:])
    return csr_array((entries, columns, starts), shape=(len(counts), width))


def _order(size: int) -> Int[np.ndarray, " unknown"]:
    """Return the order in which roots are chosen: random within blocks."""
    within = np.random.default_rng(0).permutation(min(size, _BLOCK))
    order = (np.arange(0, size, _BLOCK)[:, None] + within).ravel() if size else within
    return order[order < size]


def _near_kernel(matrix: csr_array) -> Float[np.ndarray, " unknown"]:
    """Return the near-kernel vector: ones, smoothed."""
    found, diagonal = np.ones(matrix.shape[0]), dominant_diagonal(matrix)
    for _ in range(_KERNEL_STEPS):
        found = found - _DAMPING * (matrix @ found) / diagonal
    return np.maximum(np.abs(found), _MIN_KERNEL)


def _averaged(matrix: csr_array) -> csr_array:
    """Return the prolongation for a matrix whose near-kernel is constant."""
    size = matrix.shape[0]
    rows = np.repeat(np.arange(size, dtype=matrix.indices.dtype), np.diff(matrix.indptr))
    couplings = np.where(rows == matrix.indices, 0, np.maximum(-matrix.data, 0))
    largest = _over_rows(matrix.indptr, couplings, np.maximum)
    coupled = _over_rows(matrix.indptr, couplings, np.add) > _COUPLED * matrix.diagonal()

    label = _aggregates(matrix, rows, couplings, largest, coupled)
    member = label >= 0
    aggregate = csr_array(
        (np.ones(int(member.sum())), (np.flatnonzero(member), label[member])),
        shape=(size, int(label.max(initial=-1)) + 1),
    )
    kept = couplings > np.maximum(_STRONG * largest[rows], 0)
    neighbourhood = _selected(matrix, rows, kept, couplings)
    total = neighbourhood.sum(axis=1) + np.maximum(matrix.sum(axis=1), 0)
    fraction = np.divide(_DAMPING, total, out=np.zeros(size), where=total > 0)
    neighbourhood.data *= np.repeat(fraction, np.diff(neighbourhood.indptr))
    smoothed: csr_array = (neighbourhood @ aggregate) + (1 - _DAMPING) * aggregate
    return smoothed.tocsr()


def _aggregates(
    matrix: csr_array,
    rows: Int[np.ndarray, " entry"],
    couplings: Float[np.ndarray, " entry"],
    largest: Float[np.ndarray, " unknown"],
    coupled: Bool[np.ndarray, " unknown"],
) -> Int[np.ndarray, " unknown"]:
    """Label the unknowns by aggregate; -1 for those without."""
    cols = matrix.indices
    strong = (couplings > 0) & (couplings >= _STRONG * np.maximum(largest[rows], largest[cols]))
    strong &= coupled[rows] & coupled[cols]
    graph = _selected(matrix, rows, strong, couplings)
    label = _aggregated(graph)
    leader = np.full(len(coupled), -1)
    strongest = (couplings > 0) & (couplings == largest[rows])
    leader[rows[strongest]] = cols[strongest]
    # Couplings grow along leaders by 1 / _STRONG a step at least, so that chains are short.
    unassigned = np.flatnonzero((label < 0) & coupled & (leader >= 0))
    while len(unassigned):
        label[unassigned] = label[leader[unassigned]]
        remaining = unassigned[label[unassigned] < 0]
        if len(remaining) == len(unassigned):
            break
        unassigned = remaining
    return label


def _aggregated(graph: csr_array) -> Int[np.ndarray, " unknown"]:
    """Label unknowns within two steps of roots, which are more than two steps apart."""
    size = graph.shape[0]
    rank = np.empty(size, dtype=int)
    rank[_order(size)] = np.arange(size)[::-1]
    root = np.zeros(size, dtype=bool)
    free = np.diff(graph.indptr) > 0
    while free.any():
        key = np.where(root, size + rank, np.where(free, rank, -1))
        neighbourhood = np.maximum(key, _over_rows(graph.indptr, key[graph.indices], np.maximum))
        neighbourhood = np.maximum(
            neighbourhood, _over_rows(graph.indptr, neighbourhood[graph.indices], np.maximum)
        )
        root |= free & (neighbourhood == key)
        free &= ~root & (neighbourhood < size)
    label = np.full(size, -1)
    label[root] = np.arange(int(root.sum()))
    rows = np.repeat(np.arange(size, dtype=graph.indices.dtype), np.diff(graph.indptr))
    for _ in range(2):
        coupling = np.where(label[graph.indices] >= 0, graph.data, 0)
        most = _over_rows(graph.indptr, coupling, np.maximum)
        joins = (coupling > 0) & (coupling == most[rows]) & (label[rows] < 0)
        label[rows[joins]] = label[graph.indices[joins]]
    return label


def _over_rows(
    starts: Int[np.ndarray, " bound"], values: np.ndarray, reduce: np.ufunc
) -> np.ndarray:
    """Reduce the entries of every row; 0 for rows without any."""
    found = np.zeros(len(starts) - 1, dtype=values.dtype)
    filled = np.diff(starts) > 0
    if filled.any():
        found[filled] = reduce.reduceat(values, starts[:-1][filled])
    return found


def _selected(
    matrix: csr_array,
    rows: Int[np.ndarray, " entry"],
    kept: Bool[np.ndarray, " entry"],
    values: Float[np.ndarray, " entry"],
) -> csr_array:
    """Return the matrix of some of the entries, with other values."""
    starts = np.zeros_like(matrix.indptr)
    np.cumsum(np.bincount(rows[kept], minlength=matrix.shape[0]), out=starts[1:])
    return csr_array((values[kept], matrix.indices[kept], starts), shape=matrix.shape)
