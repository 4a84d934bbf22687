"""Coarser unknowns for a sparse symmetric matrix: what ``linalg/aggregation.py`` does in numpy.

Matrices are compressed rows, both triangles. Names and constants are those of that module. Where
there are a ``first`` and a ``last`` row, nothing is done for any but those between.
"""

import numpy as np

from pimper_torch.kernels.switch import compiled

Array = np.ndarray

_MATRIX = "int32[::1], int32[::1], float64[::1]"
_ROWS = "int64, int64"
_FOUND = "Tuple((int32[::1], int32[::1], float64[::1]))"


@compiled(f"void({_MATRIX}, float64[::1], float64[::1], {_ROWS})")
def diagonals(
    starts: Array,
    columns: Array,
    entries: Array,
    diagonal: Array,
    dominant: Array,
    first: int,
    last: int,
) -> None:
    """Write the diagonal, and one with which Jacobi's iteration has a spectrum within [0, 2]."""
    for row in range(first, last):
        total, own = 0.0, 0.0
        for place in range(starts[row], starts[row + 1]):
            total += abs(entries[place])
            if columns[place] == row:
                own += entries[place]
        diagonal[row] = own
        dominant[row] = max(own, total / 2)


@compiled(f"UniTuple(float64, 2)({_MATRIX}, {_ROWS})")
def off_diagonal(
    starts: Array, columns: Array, entries: Array, first: int, last: int
) -> tuple[float, float]:
    """Add up the positive entries off the diagonal, and the sizes of all of them."""
    positive, size = 0.0, 0.0
    for row in range(first, last):
        for place in range(starts[row], starts[row + 1]):
            if columns[place] != row:
                positive += max(entries[place], 0.0)
                size += abs(entries[place])
    return positive, size


@compiled(f"void({_MATRIX}, float64[::1], float64[::1], float64[::1], float64, {_ROWS})")
def smooth_ones(
    starts: Array,
    columns: Array,
    entries: Array,
    dominant: Array,
    ones: Array,
    smoother: Array,
    damping: float,
    first: int,
    last: int,
) -> None:
    """Take one damped step of Jacobi's iteration from ``ones`` towards 0."""
    for row in range(first, last):
        image = 0.0
        for place in range(starts[row], starts[row + 1]):
            image += entries[place] * ones[columns[place]]
        smoother[row] = ones[row] - damping * image / dominant[row]


@compiled(f"void({_MATRIX}, float64[::1], float64[::1], float64[::1], float64[::1], {_ROWS})")
def ties(
    starts: Array,
    columns: Array,
    entries: Array,
    units: Array,
    largest: Array,
    tied: Array,
    excess: Array,
    first: int,
    last: int,
) -> None:
    """Write each row's largest tie, the sum of ties over the diagonal, and the row's sum.

    A tie is minus an entry off the diagonal, of the matrix in units, if it is positive.
    """
    for row in range(first, last):
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
    f"void({_MATRIX}, float64[::1], float64[::1], float64[::1], float64, float64, boolean[::1], "
    f"{_ROWS})"
)
def strong_ties(
    starts: Array,
    columns: Array,
    entries: Array,
    units: Array,
    largest: Array,
    tied: Array,
    least_strong: float,
    least_tied: float,
    strong: Array,
    first: int,
    last: int,
) -> None:
    """Mark entries that may found an aggregate.

    Args:
        starts: Of the rows.
        columns: Of the entries.
        entries: Of the matrix.
        units: What unknowns are measured in.
        largest: Tie of each row.
        tied: Sum of each row's ties over its diagonal.
        least_strong: Of an entry next to the largest of both rows.
        least_tied: Of an unknown that is not left to smoothing.
        strong: Written.
        first: Row.
        last: Row after those.
    """
    for row in range(first, last):
        for place in range(starts[row], starts[row + 1]):
            column = columns[place]
            tie = -units[row] * entries[place] * units[column]
            strong[place] = (
                tie > 0
                and column != row
                and tied[row] > least_tied
                and tied[column] > least_tied
                and tie >= least_strong * max(largest[row], largest[column])
            )


@compiled("int32(int32[::1], int32[::1], boolean[::1], int64[::1], int32[::1])")
def roots(starts: Array, columns: Array, strong: Array, order: Array, label: Array) -> int:
    """Number unknowns more than two strong ties apart, taken in order; -1 for the others."""
    covered = np.zeros(len(label), np.bool_)
    label[:] = -1
    for row in order:
        if covered[row]:
            continue
        for place in range(starts[row], starts[row + 1]):
            if strong[place]:
                label[row] = 0
                near = columns[place]
                covered[near] = True
                for beyond in range(starts[near], starts[near + 1]):
                    if strong[beyond]:
                        covered[columns[beyond]] = True
    count = 0
    for row in range(len(label)):
        if label[row] == 0:
            label[row] = count
            count += 1
    return count


@compiled(f"void({_MATRIX}, float64[::1], boolean[::1], int32[::1], int32[::1], {_ROWS})")
def joined(
    starts: Array,
    columns: Array,
    entries: Array,
    units: Array,
    strong: Array,
    label: Array,
    found: Array,
    first: int,
    last: int,
) -> None:
    """Write labels where those without one have that of their strongest tie that has one."""
    for row in range(first, last):
        found[row] = label[row]
        if label[row] >= 0:
            continue
        most = 0.0
        for place in range(starts[row], starts[row + 1]):
            column = columns[place]
            if strong[place] and label[column] >= 0:
                tie = -units[row] * entries[place] * units[column]
                if tie >= most:
                    most = tie
                    found[row] = label[column]


@compiled(
    f"boolean({_MATRIX}, float64[::1], float64[::1], float64[::1], float64, int32[::1], "
    f"int32[::1], {_ROWS})"
)
def followed(
    starts: Array,
    columns: Array,
    entries: Array,
    units: Array,
    largest: Array,
    tied: Array,
    least_tied: float,
    label: Array,
    found: Array,
    first: int,
    last: int,
) -> bool:
    """Write labels where those without one have that of what they are tied to most; tell if any.

    Ties grow along such chains, so that they are short.
    """
    moved = False
    for row in range(first, last):
        found[row] = label[row]
        if label[row] >= 0 or tied[row] <= least_tied or largest[row] <= 0:
            continue
        leader = -1
        for place in range(starts[row], starts[row + 1]):
            column = columns[place]
            if column != row and -units[row] * entries[place] * units[column] == largest[row]:
                leader = column
        if leader >= 0 and label[leader] >= 0:
            found[row] = label[leader]
            moved = True
    return moved


@compiled(
    f"{_FOUND}({_MATRIX}, float64[::1], float64[::1], float64[::1], int32[::1], float64, float64, "
    f"{_ROWS})"
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
    first: int,
    last: int,
) -> tuple[Array, Array, Array]:
    """Give rows of the prolongation: aggregates, smoothed by one averaging step, in units.

    Returns:
        How many entries each row has, their columns, and the entries.
    """
    counts = np.empty(last - first, np.int32)
    room = starts[last] - starts[first] + last - first
    names, values = np.empty(room, np.int32), np.empty(room)
    count = 0
    for row in range(first, last):
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
        fraction = damping / total if total > 0 else 0.0
        for at in range(begin, count):
            values[at] *= fraction * units[row]
        if label[row] >= 0:
            values[begin] += (1 - damping) * units[row]
        counts[row - first] = count - begin
    return counts, names[:count].copy(), values[:count].copy()


@compiled(f"{_FOUND}({_MATRIX}, {_MATRIX}, {_MATRIX}, {_ROWS})")
def coarser(
    starts: Array,
    columns: Array,
    entries: Array,
    spread_starts: Array,
    spread_columns: Array,
    spread_entries: Array,
    gather_starts: Array,
    gather_columns: Array,
    gather_entries: Array,
    first: int,
    last: int,
) -> tuple[Array, Array, Array]:
    """Give rows of ``P^T A P``: what :func:`spread` gives of them; no product between is kept.

    Args:
        starts: Of the rows of A.
        columns: Of its entries.
        entries: Of A.
        spread_starts: Of P.
        spread_columns: Of P.
        spread_entries: Of P.
        gather_starts: Of P^T.
        gather_columns: Of P^T.
        gather_entries: Of P^T.
        first: Row.
        last: Row after those.
    """
    size = len(gather_starts) - 1
    counts = np.empty(last - first, np.int32)
    seen, listed, sums = np.full(size, -1, np.int32), np.empty(size, np.int32), np.empty(size)
    room = 16 * (last - first)
    names, values = np.empty(room, np.int32), np.empty(room)
    filled = 0
    for row in range(first, last):
        count = 0
        for one in range(gather_starts[row], gather_starts[row + 1]):
            fine, weight = np.uint32(gather_columns[one]), gather_entries[one]
            for two in range(starts[fine], starts[fine + 1]):
                near, tie = np.uint32(columns[two]), weight * entries[two]
                for three in range(spread_starts[near], spread_starts[near + 1]):
                    name = np.uint32(spread_columns[three])
                    if seen[name] == row:
                        sums[name] += tie * spread_entries[three]
                    else:
                        seen[name] = row
                        sums[name] = tie * spread_entries[three]
                        listed[count] = name
                        count += 1
        if filled + count > room:
            room = 2 * room + count
            more, still = np.empty(room, np.int32), np.empty(room)
            more[:filled], still[:filled] = names[:filled], values[:filled]
            names, values = more, still
        for place in range(count):
            name = listed[place]
            names[filled + place], values[filled + place] = name, sums[name]
        filled += count
        counts[row - first] = count
    return counts, names[:filled].copy(), values[:filled].copy()
