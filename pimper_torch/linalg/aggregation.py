r"""Coarser unknowns for a sparse symmetric matrix, from nothing but its entries.

A level of algebraic multigrid by smoothed aggregation: unknowns that strong entries tie
together become one coarse unknown, and one averaging step spreads it over its neighbours.
What makes it hold where entries jump by ten orders is the reading of *strong*:

- Two unknowns may *found* an aggregate together only if their entry is large beside the
  largest of both rows. A light unknown between two heavy ones must not tie them together.
- An unknown without such an entry *follows* the one it is tied to most. Left out instead, it
  would stay behind when its heavy neighbour moves, and pollute the coarse energy.

What moves together need not move equally far: heights along two directions, one of them nearly
in the surface, differ by a factor. So unknowns are measured in units of a vector that the matrix
hardly sees (ones, smoothed), in which what coarse unknowns spread is constant.

On a raster with equal weights the aggregates are patches of about 3 x 3 pixels; along a
strip between two cuts they are pieces of the strip; a hole has none.

Source: Vanek, Mandel & Brezina, Computing 56, 1996, for smoothed aggregation; Bell, Dalton &
Olson, SIAM J. Sci. Comput. 34(4), 2012, for founding aggregates in parallel; Brezina, Falgout,
MacLachlan, Manteuffel, McCormick & Ruge, SIAM J. Sci. Comput. 25(6), 2004, for smoothing what
is to be spread. The following of light unknowns is ours, measured in
``benchmarks/linear_systems.py``.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array, diags_array

from pimper_torch.kernels.switch import compiled_for
from pimper_torch.parallel import over_rows

# An entry is strong if it is at least this fraction of the largest of a row; compared by
# iterations on weights that vary over 0 to 10 orders, where 0.1 takes up to 1.6 times as many.
_STRONG = 0.25

# An unknown whose neighbours make up less than this fraction of its diagonal is determined by its
# own anchor: smoothing alone solves for it.
_TIED = 0.05

# Smoothing steps by which ones become the vector that the matrix hardly sees. The fusion of
# potatoes took 25 cycles without, 18 with two, 17 with five and with more.
_UNIT_STEPS = 5

# Where an anchor or a fold would have that vector vanish it keeps this much.
_MIN_UNIT = 0.1

# Of the averaging step that smooths the aggregates' edges; 2/3 damps the highest frequencies
# of an M-matrix best.
_DAMPING = 2 / 3

# Unknowns that are asked in any order among themselves, and after all before them: they and what
# they are tied to fit the cache.
_NEAR = 4096


def prolongation(matrix: csr_array) -> csr_array:
    """Give the map from coarse unknowns to those of ``matrix``.

    Args:
        matrix: Symmetric, its diagonal positive; best with few positive entries off it.

    Returns:
        One column a coarse unknown, not negative. Rows of unknowns that no entry ties to others
        are empty, the others add up to their unit where no anchor (excess of the diagonal)
        holds them.
    """
    if compiled_for():
        return _compiled(matrix)
    units = diags_array(_units(matrix))
    found: csr_array = (units @ _averaged((units @ matrix @ units).tocsr())).tocsr()
    return found


def dominant_diagonal(matrix: csr_array) -> Float[np.ndarray, " unknown"]:
    """Give a diagonal with which Jacobi's iteration has a spectrum within [0, 2].

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
    """Give the same map by compiled kernels."""
    from pimper_torch.kernels import aggregation as kernels

    parts, size = parts_of(matrix), matrix.shape[0]
    dominant, units = dominant_diagonal(matrix), np.ones(size)
    smoother = np.empty(size)
    for _ in range(_UNIT_STEPS):
        over_rows(kernels.smooth_ones, size, *parts, dominant, units, smoother, _DAMPING)
        units, smoother = smoother, units
    units = np.maximum(np.abs(units, out=units), _MIN_UNIT, out=units)
    largest, tied, excess = dominant, smoother, np.empty(size)  # memory that is free
    over_rows(kernels.ties, size, *parts, units, largest, tied, excess)
    strong, label = np.empty(len(parts[1]), np.bool_), np.empty(size, np.int32)
    tying = units, largest, tied
    over_rows(kernels.strong_ties, size, *parts, *tying, _STRONG, _TIED, strong)
    count = kernels.roots(*parts[:2], strong, _order(size), label)
    other = np.empty_like(label)
    for _ in range(2):
        over_rows(kernels.joined, size, *parts, units, strong, label, other)
        label, other = other, label
    while any(over_rows(kernels.followed, size, *parts, *tying, _TIED, label, other)):
        label, other = other, label
    found = over_rows(
        kernels.spread, size, *parts, units, largest, excess, label, _STRONG, _DAMPING
    )
    return _joined(found, count)


def coarser(matrix: csr_array, spread: csr_array, gather: csr_array) -> csr_array:
    """Give the matrix of the coarse unknowns.

    Args:
        matrix: Of the fine ones.
        spread: As :func:`prolongation` gives it.
        gather: Its transpose.
    """
    if compiled_for():
        from pimper_torch.kernels import aggregation as kernels

        parts = [part for each in (matrix, spread, gather) for part in parts_of(each)]
        return _joined(over_rows(kernels.coarser, gather.shape[0], *parts), gather.shape[0])
    found: csr_array = gather @ (matrix @ spread)
    return found


def parts_of(matrix: csr_array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give a matrix as kernels take it: where rows start, columns and entries."""
    return matrix.indptr, matrix.indices, matrix.data


def _joined(found: list[tuple[np.ndarray, np.ndarray, np.ndarray]], width: int) -> csr_array:
    """Make one matrix of some rows after others: how many entries they have, columns, entries."""
    counts, columns, entries = (np.concatenate(parts) for parts in zip(*found, strict=True))
    starts = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=starts[1:])
    return csr_array((entries, columns, starts), shape=(len(counts), width))


def _order(size: int) -> Int[np.ndarray, " unknown"]:
    """Give the order in which unknowns are asked to be roots: any, but near ones together."""
    within = np.random.default_rng(0).permutation(min(size, _NEAR))
    order = (np.arange(0, size, _NEAR)[:, None] + within).ravel() if size else within
    return order[order < size]


def _units(matrix: csr_array) -> Float[np.ndarray, " unknown"]:
    """Smooth ones until the matrix hardly sees them."""
    found, diagonal = np.ones(matrix.shape[0]), dominant_diagonal(matrix)
    for _ in range(_UNIT_STEPS):
        found = found - _DAMPING * (matrix @ found) / diagonal
    return np.maximum(np.abs(found), _MIN_UNIT)


def _averaged(matrix: csr_array) -> csr_array:
    """Give the map from coarse unknowns to those of a matrix that hardly sees constants."""
    size = matrix.shape[0]
    rows = np.repeat(np.arange(size, dtype=matrix.indices.dtype), np.diff(matrix.indptr))
    ties = np.where(rows == matrix.indices, 0, np.maximum(-matrix.data, 0))
    largest = _over_rows(matrix.indptr, ties, np.maximum)
    tied = _over_rows(matrix.indptr, ties, np.add) > _TIED * matrix.diagonal()

    label = _aggregates(matrix, rows, ties, largest, tied)
    member = label >= 0
    aggregate = csr_array(
        (np.ones(int(member.sum())), (np.flatnonzero(member), label[member])),
        shape=(size, int(label.max(initial=-1)) + 1),
    )
    kept = ties > np.maximum(_STRONG * largest[rows], 0)
    near = _selected(matrix, rows, kept, ties)
    total = near.sum(axis=1) + np.maximum(matrix.sum(axis=1), 0)
    fraction = np.divide(_DAMPING, total, out=np.zeros(size), where=total > 0)
    near.data *= np.repeat(fraction, np.diff(near.indptr))
    smoothed: csr_array = (near @ aggregate) + (1 - _DAMPING) * aggregate
    return smoothed.tocsr()


def _aggregates(
    matrix: csr_array,
    rows: Int[np.ndarray, " entry"],
    ties: Float[np.ndarray, " entry"],
    largest: Float[np.ndarray, " unknown"],
    tied: Bool[np.ndarray, " unknown"],
) -> Int[np.ndarray, " unknown"]:
    """Label the unknowns by aggregate; -1 for those that need none."""
    cols = matrix.indices
    strong = (ties > 0) & (ties >= _STRONG * np.maximum(largest[rows], largest[cols]))
    strong &= tied[rows] & tied[cols]
    graph = _selected(matrix, rows, strong, ties)
    label = _founded(graph)
    leader = np.full(len(tied), -1)
    at_most = (ties > 0) & (ties == largest[rows])
    leader[rows[at_most]] = cols[at_most]
    # Ties grow along leaders by 1 / _STRONG a step at least, so that chains are short.
    late = np.flatnonzero((label < 0) & tied & (leader >= 0))
    while len(late):
        label[late] = label[leader[late]]
        remaining = late[label[late] < 0]
        if len(remaining) == len(late):
            break
        late = remaining
    return label


def _founded(graph: csr_array) -> Int[np.ndarray, " unknown"]:
    """Label what lies within two steps of roots that are more than two steps apart."""
    size = graph.shape[0]
    rank = np.empty(size, dtype=int)
    rank[_order(size)] = np.arange(size)[::-1]
    root = np.zeros(size, dtype=bool)
    open_ = np.diff(graph.indptr) > 0
    while open_.any():
        key = np.where(root, size + rank, np.where(open_, rank, -1))
        near = np.maximum(key, _over_rows(graph.indptr, key[graph.indices], np.maximum))
        near = np.maximum(near, _over_rows(graph.indptr, near[graph.indices], np.maximum))
        root |= open_ & (near == key)
        open_ &= ~root & (near < size)
    label = np.full(size, -1)
    label[root] = np.arange(int(root.sum()))
    rows = np.repeat(np.arange(size, dtype=graph.indices.dtype), np.diff(graph.indptr))
    for _ in range(2):
        regularization = np.where(label[graph.indices] >= 0, graph.data, 0)
        most = _over_rows(graph.indptr, regularization, np.maximum)
        joins = (regularization > 0) & (regularization == most[rows]) & (label[rows] < 0)
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
    """Give the matrix of some of the entries, with other values."""
    starts = np.zeros_like(matrix.indptr)
    np.cumsum(np.bincount(rows[kept], minlength=matrix.shape[0]), out=starts[1:])
    return csr_array((values[kept], matrix.indices[kept], starts), shape=matrix.shape)
