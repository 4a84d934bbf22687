"""Coarser unknowns for a sparse symmetric matrix: what ``linalg/aggregation.py`` does in numpy.

Matrices are compressed rows, both triangles. Names and constants are those of that module.
"""

import numpy as np

from pimper_torch.kernels.switch import compiled

Array = np.ndarray

_MATRIX = "int32[::1], int32[::1], float64[::1]"
_FOUND = "Tuple((int32[::1], int32[::1], float64[::1]))"


@compiled(f"void({_MATRIX}, float64[::1], float64[::1])")
def diagonals(
    starts: Array, columns: Array, entries: Array, diagonal: Array, dominant: Array
) -> None:
    """Write the diagonal, and one with which Jacobi's iteration has a spectrum within [0, 2]."""
    for row in range(len(diagonal)):
        total, own = 0.0, 0.0
        for place in range(starts[row], starts[row + 1]):
            total += abs(entries[place])
            if columns[place] == row:
                own += entries[place]
        diagonal[row] = own
        dominant[row] = max(own, total / 2)


@compiled(f"void({_MATRIX}, float64[::1], float64[::1], float64[::1], float64)")
def smooth_ones(
    starts: Array,
    columns: Array,
    entries: Array,
    dominant: Array,
    ones: Array,
    smoother: Array,
    damping: float,
) -> None:
    """Take one damped step of Jacobi's iteration from ``ones`` towards 0."""
    for row in range(len(ones)):
        image = 0.0
        for place in range(starts[row], starts[row + 1]):
            image += entries[place] * ones[columns[place]]
        smoother[row] = ones[row] - damping * image / dominant[row]


@compiled(f"void({_MATRIX}, float64[::1], float64[::1], float64[::1], float64[::1])")
def ties(
    starts: Array,
    columns: Array,
    entries: Array,
    units: Array,
    largest: Array,
    tied: Array,
    excess: Array,
) -> None:
    """Write each row's largest tie, the sum of ties over the diagonal, and the row's sum.

    A tie is minus an entry off the diagonal, of the matrix in units, if it is positive.
    """
    for row in range(len(units)):
        most, total, own, rest = 0.0, 0.0, 0.0, 0.0
        for place in range(starts[row], starts[row + 1]):
            column = columns[place]
            entry = units[row] * entries[place] * units[column]
            rest += entry
            if column == row:
                own += entry
            elif entry < 0:
                total -= entry
                most = max(most, -entry)
        largest[row] = most
        tied[row] = total / own
        excess[row] = rest


@compiled(
    f"int32({_MATRIX}, float64[::1], float64[::1], float64[::1], int64[::1], float64, float64, "
    "int32[::1])"
)
def aggregate(
    starts: Array,
    columns: Array,
    entries: Array,
    units: Array,
    largest: Array,
    tied: Array,
    order: Array,
    least_strong: float,
    least_tied: float,
    label: Array,
) -> int:
    """Label the unknowns by aggregate, -1 for those that need none, and count the aggregates.

    Args:
        starts: Of the rows.
        columns: Of the entries.
        entries: Of the matrix.
        units: What unknowns are measured in.
        largest: Tie of each row.
        tied: Sum of each row's ties over its diagonal.
        order: In which unknowns are asked to be roots.
        least_strong: Of an entry next to the largest of both rows.
        least_tied: Of an unknown that is not left to smoothing.
        label: Written.
    """
    size = len(units)
    strong = np.zeros(len(columns), np.bool_)
    for row in range(size):
        if tied[row] > least_tied:
            for place in range(starts[row], starts[row + 1]):
                column = columns[place]
                tie = -units[row] * entries[place] * units[column]
                if tie > 0 and column != row and tied[column] > least_tied:
                    strong[place] = tie >= least_strong * max(largest[row], largest[column])
    covered = np.zeros(size, np.bool_)
    rank = np.full(size, -1, np.int32)
    for row in order:
        if covered[row]:
            continue
        alone = True
        for place in range(starts[row], starts[row + 1]):
            if strong[place]:
                alone = False
                near = columns[place]
                covered[near] = True
                for beyond in range(starts[near], starts[near + 1]):
                    if strong[beyond]:
                        covered[columns[beyond]] = True
        if not alone:
            rank[row] = 0
    count = 0
    for row in range(size):
        label[row] = -1
        if rank[row] == 0:
            label[row] = count
            count += 1
    joined = label.copy()
    for _ in range(2):
        for row in range(size):
            if label[row] >= 0:
                continue
            most = 0.0
            for place in range(starts[row], starts[row + 1]):
                column = columns[place]
                if strong[place] and label[column] >= 0:
                    tie = -units[row] * entries[place] * units[column]
                    if tie >= most:
                        most = tie
                        joined[row] = label[column]
        label[:] = joined
    # Ties grow along leaders, so that chains are short.
    moved = True
    while moved:
        moved = False
        for row in range(size):
            if label[row] >= 0 or tied[row] <= least_tied or largest[row] <= 0:
                continue
            leader = -1
            for place in range(starts[row], starts[row + 1]):
                column = columns[place]
                if column != row and -units[row] * entries[place] * units[column] == largest[row]:
                    leader = column
            if leader >= 0 and label[leader] >= 0:
                joined[row] = label[leader]
                moved = True
        label[:] = joined
    return count


@compiled(
    f"{_FOUND}({_MATRIX}, float64[::1], float64[::1], float64[::1], int32[::1], float64, float64)"
)
def spread(
    starts: Array,
    columns: Array,
    entries: Array,
    units: Array,
    largest: Array,
    excess: Array,
    label: Array,
    least_strong: float,
    damping: float,
) -> tuple[Array, Array, Array]:
    """Give the prolongation: aggregates, smoothed by one averaging step, in units."""
    size = len(units)
    first = np.zeros(size + 1, np.int32)
    room = len(columns) + size
    names, values = np.empty(room, np.int32), np.empty(room)
    count = 0
    for row in range(size):
        begin = count
        total = max(excess[row], 0.0)
        if label[row] >= 0:
            names[count], values[count] = label[row], 0.0
            count += 1
        for place in range(starts[row], starts[row + 1]):
            column = columns[place]
            if column == row:
                continue
            tie = -units[row] * entries[place] * units[column]
            if not (tie > 0 and tie > least_strong * largest[row]):
                continue
            total += tie
            if label[column] < 0:
                continue
            at = begin
            while at < count and names[at] != label[column]:
                at += 1
            if at == count:
                names[at], values[at] = label[column], 0.0
                count += 1
            values[at] += tie
        share = damping / total if total > 0 else 0.0
        for at in range(begin, count):
            values[at] *= share * units[row]
        if label[row] >= 0:
            values[begin] += (1 - damping) * units[row]
        first[row + 1] = count
    return first, names[:count].copy(), values[:count].copy()
