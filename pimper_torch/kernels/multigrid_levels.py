"""Aggregates and prolongation of algebraic multigrid, for ``linalg/aggregation.py``.

Matrices are compressed rows of both triangles. Functions with ``first`` and ``last`` compute these.
"""

import numpy as np

from pimper_torch.kernels.compile import compiled

Array = np.ndarray

_MATRIX = "int32[::1], int32[::1], float64[::1]"
_ROWS = "int64, int64"
_BLOCK = "Tuple((int32[::1], int32[::1], float64[::1]))"


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
    """Write the diagonal, and one for which Jacobi's iteration has a spectrum within [0, 2]."""
    for row in range(first, last):
        total, center = 0.0, 0.0
        for index in range(starts[row], starts[row + 1]):
            total += abs(entries[index])
            if columns[index] == row:
                center += entries[index]
        diagonal[row] = center
        dominant[row] = max(center, total / 2)


@compiled(f"UniTuple(float64, 2)({_MATRIX}, {_ROWS})")
def off_diagonal(
    starts: Array, columns: Array, entries: Array, first: int, last: int
) -> tuple[float, float]:
    """Return the sums of the positive off-diagonal entries and of all their absolute values."""
    positive, size = 0.0, 0.0
    for row in range(first, last):
        for index in range(starts[row], starts[row + 1]):
            if columns[index] != row:
                positive += max(entries[index], 0.0)
                size += abs(entries[index])
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
        for index in range(starts[row], starts[row + 1]):
            image += entries[index] * ones[columns[index]]
        smoother[row] = ones[row] - damping * image / dominant[row]


@compiled(f"void({_MATRIX}, float64[::1], float64[::1], float64[::1], float64[::1], {_ROWS})")
def couplings(
    starts: Array,
    columns: Array,
    entries: Array,
    scale: Array,
    largest: Array,
    coupled: Array,
    excess: Array,
    first: int,
    last: int,
) -> None:
    """Write each row's largest coupling, the sum of couplings over the diagonal, and the row sum.

    Couplings are the negated negative entries off the diagonal of the scaled matrix.
    """
    for row in range(first, last):
        most, total, center, row_sum = 0.0, 0.0, 0.0, 0.0
        for index in range(starts[row], starts[row + 1]):
            column = columns[index]
            entry = scale[row] * entries[index] * scale[column]
            row_sum += entry
            if column == row:
                center += entry
            elif entry < 0:
                total -= entry
                most = max(most, -entry)
        largest[row] = most
        coupled[row] = total / center
        excess[row] = row_sum


@compiled(
    f"void({_MATRIX}, float64[::1], float64[::1], float64[::1], float64, float64, boolean[::1], "
    f"{_ROWS})"
)
def strong_connections(
    starts: Array,
    columns: Array,
    entries: Array,
    scale: Array,
    largest: Array,
    coupled: Array,
    min_strength: float,
    min_coupled: float,
    strong: Array,
    first: int,
    last: int,
) -> None:
    """Mark the strong connections, which may root an aggregate, in ``strong``.

    Args:
        largest: Largest coupling of each row.
        coupled: Sum of each row's couplings over its diagonal.
        min_strength: Minimum ratio of an entry to the largest coupling of both rows.
        min_coupled: Minimum of ``coupled``; below it, smoothing alone solves for an unknown.
    """
    for row in range(first, last):
        for index in range(starts[row], starts[row + 1]):
            column = columns[index]
            coupling = -scale[row] * entries[index] * scale[column]
            strong[index] = (
                coupling > 0
                and column != row
                and coupled[row] > min_coupled
                and coupled[column] > min_coupled
                and coupling >= min_strength * max(largest[row], largest[column])
            )


@compiled("int32(int32[::1], int32[::1], boolean[::1], int64[::1], int32[::1])")
def roots(starts: Array, columns: Array, strong: Array, order: Array, label: Array) -> int:
    """Number the roots, over two strong connections apart; -1 for others. Return their count."""
    covered = np.zeros(len(label), np.bool_)
    label[:] = -1
    for row in order:
        if covered[row]:
            continue
        for index in range(starts[row], starts[row + 1]):
            if strong[index]:
                label[row] = 0
                neighbour = columns[index]
                covered[neighbour] = True
                for second in range(starts[neighbour], starts[neighbour + 1]):
                    if strong[second]:
                        covered[columns[second]] = True
    count = 0
    for row in range(len(label)):
        if label[row] == 0:
            label[row] = count
            count += 1
    return count


@compiled(f"void({_MATRIX}, float64[::1], boolean[::1], int32[::1], int32[::1], {_ROWS})")
def assigned(
    starts: Array,
    columns: Array,
    entries: Array,
    scale: Array,
    strong: Array,
    label: Array,
    new_label: Array,
    first: int,
    last: int,
) -> None:
    """Assign unlabelled unknowns the label of their strongest labelled connection."""
    for row in range(first, last):
        new_label[row] = label[row]
        if label[row] >= 0:
            continue
        most = 0.0
        for index in range(starts[row], starts[row + 1]):
            column = columns[index]
            if strong[index] and label[column] >= 0:
                coupling = -scale[row] * entries[index] * scale[column]
                if coupling >= most:
                    most = coupling
                    new_label[row] = label[column]


@compiled(
    f"boolean({_MATRIX}, float64[::1], float64[::1], float64[::1], float64, int32[::1], "
    f"int32[::1], {_ROWS})"
)
def assigned_by_coupling(
    starts: Array,
    columns: Array,
    entries: Array,
    scale: Array,
    largest: Array,
    coupled: Array,
    min_coupled: float,
    label: Array,
    new_label: Array,
    first: int,
    last: int,
) -> bool:
    """Assign unlabelled unknowns the label of their largest coupling; return if any changed.

    Couplings grow along such chains, so the chains are short.
    """
    changed = False
    for row in range(first, last):
        new_label[row] = label[row]
        if label[row] >= 0 or coupled[row] <= min_coupled or largest[row] <= 0:
            continue
        strongest = -1
        for index in range(starts[row], starts[row + 1]):
            column = columns[index]
            if column != row and -scale[row] * entries[index] * scale[column] == largest[row]:
                strongest = column
        if strongest >= 0 and label[strongest] >= 0:
            new_label[row] = label[strongest]
            changed = True
    return changed


@compiled(
    f"{_BLOCK}({_MATRIX}, float64[::1], float64[::1], float64[::1], int32[::1], float64, float64, "
    f"{_ROWS})"
)
def prolongation(
    starts: Array,
    columns: Array,
    entries: Array,
    scale: Array,
    largest: Array,
    excess: Array,
    label: Array,
    min_strength: float,
    damping: float,
    first: int,
    last: int,
) -> tuple[Array, Array, Array]:
    """Return rows of the prolongation: aggregates, smoothed by one averaging step.

    Returns:
        Numbers of entries per row, their columns, and the entries.
    """
    counts = np.empty(last - first, np.int32)
    capacity = starts[last] - starts[first] + last - first
    aggregates, values = np.empty(capacity, np.int32), np.empty(capacity)
    count = 0
    for row in range(first, last):
        begin = count
        total = max(excess[row], 0.0)
        if label[row] >= 0:
            aggregates[count], values[count] = label[row], 0.0
            count += 1
        for index in range(starts[row], starts[row + 1]):
            column = columns[index]
            if column == row:
                continue
            coupling = -scale[row] * entries[index] * scale[column]
            if not (coupling > 0 and coupling > min_strength * largest[row]):
                continue
            total += coupling
            if label[column] < 0:
                continue
            slot = begin
            while slot < count and aggregates[slot] != label[column]:
                slot += 1
            if slot == count:
                aggregates[slot], values[slot] = label[column], 0.0
                count += 1
            values[slot] += coupling
        fraction = damping / total if total > 0 else 0.0
        for slot in range(begin, count):
            values[slot] *= fraction * scale[row]
        if label[row] >= 0:
            values[begin] += (1 - damping) * scale[row]
        counts[row - first] = count - begin
    return counts, aggregates[:count].copy(), values[:count].copy()


@compiled(f"{_BLOCK}({_MATRIX}, {_MATRIX}, {_MATRIX}, {_ROWS})")
def coarser(
    starts: Array,
    columns: Array,
    entries: Array,
    prolong_starts: Array,
    prolong_columns: Array,
    prolong_entries: Array,
    restrict_starts: Array,
    restrict_columns: Array,
    restrict_entries: Array,
    first: int,
    last: int,
) -> tuple[Array, Array, Array]:
    """Return rows of the Galerkin product ``P^T A P``, without an intermediate product."""
    size = len(restrict_starts) - 1
    counts = np.empty(last - first, np.int32)
    marker, touched, sums = np.full(size, -1, np.int32), np.empty(size, np.int32), np.empty(size)
    capacity = 16 * (last - first)
    aggregates, values = np.empty(capacity, np.int32), np.empty(capacity)
    filled = 0
    for row in range(first, last):
        count = 0
        for i in range(restrict_starts[row], restrict_starts[row + 1]):
            fine, weight = np.uint32(restrict_columns[i]), restrict_entries[i]
            for j in range(starts[fine], starts[fine + 1]):
                neighbour, coupling = np.uint32(columns[j]), weight * entries[j]
                for k in range(prolong_starts[neighbour], prolong_starts[neighbour + 1]):
                    aggregate = np.uint32(prolong_columns[k])
                    if marker[aggregate] == row:
                        sums[aggregate] += coupling * prolong_entries[k]
                    else:
                        marker[aggregate] = row
                        sums[aggregate] = coupling * prolong_entries[k]
                        touched[count] = aggregate
                        count += 1
        if filled + count > capacity:
            capacity = 2 * capacity + count
            wider_columns, wider_values = np.empty(capacity, np.int32), np.empty(capacity)
            for index in range(filled):
                wider_columns[index], wider_values[index] = aggregates[index], values[index]
            aggregates, values = wider_columns, wider_values
        for index in range(count):
            aggregate = touched[index]
            aggregates[filled + index], values[filled + index] = aggregate, sums[aggregate]
        filled += count
        counts[row - first] = count
    return counts, aggregates[:filled].copy(), values[:filled].copy()
