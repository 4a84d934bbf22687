"""Normal equations of sparse least squares, assembled in compressed rows."""

import numpy as np

from pimper_torch.kernels.compile import compiled

Array = np.ndarray

_REALS = ("float32", "float64")


@compiled("void(int64[:,::1], int32[::1])")
def count(unknowns: Array, counts: Array) -> None:
    """Count the entries of each row, duplicates included."""
    for equation in range(len(unknowns)):
        for term in range(unknowns.shape[1]):
            counts[unknowns[equation, term]] += unknowns.shape[1]


@compiled(
    *(
        f"void(int64[:,::1], {real}[:,::1], float64[::1], int32[::1], int32[::1], float64[::1])"
        for real in _REALS
    )
)
def fill(
    unknowns: Array,
    coefficients: Array,
    weights: Array,
    ends: Array,
    columns: Array,
    entries: Array,
) -> None:
    """Append the entries of all equations to their rows; ``ends`` is updated."""
    terms = unknowns.shape[1]
    for equation in range(len(unknowns)):
        for first_term in range(terms):
            row = unknowns[equation, first_term]
            scaled = weights[equation] * coefficients[equation, first_term]
            for second_term in range(terms):
                slot = ends[row]
                columns[slot] = unknowns[equation, second_term]
                entries[slot] = scaled * coefficients[equation, second_term]
                ends[row] = slot + 1


@compiled(
    *(
        f"void(int64[:,::1], {real}[:,::1], {real}[::1], float64[::1], float64[::1])"
        for real in _REALS
    )
)
def add_sides(
    unknowns: Array, coefficients: Array, targets: Array, weights: Array, side: Array
) -> None:
    """Add the targets of the equations to the right-hand side."""
    for equation in range(len(unknowns)):
        weighted = weights[equation] * targets[equation]
        for term in range(unknowns.shape[1]):
            side[unknowns[equation, term]] += coefficients[equation, term] * weighted


@compiled(
    *(
        f"float64(int64[:,::1], {real}[:,::1], {real}[::1], {real}[::1], {real}[::1], "
        "float64[::1], float64[::1], float64[::1], float64[::1], float64[::1])"
        for real in _REALS
    )
)
def judge(
    unknowns: Array,
    coefficients: Array,
    targets: Array,
    information: Array,
    correlated: Array,
    weights: Array,
    heights: Array,
    probe: Array,
    answer: Array,
    square: Array,
) -> float:
    """Write squared standardized residuals to ``square``; return estimated degrees of freedom.

    They are the probe's term of the trace of the hat matrix, ``sum_e w_e i_e (a_e p) (a_e x)`` with
    ``x`` the solution (``answer``) for the probe ``p`` (Hutchinson's estimator).
    """
    used = 0.0
    for equation in range(len(unknowns)):
        residual, probed, response = float(targets[equation]), 0.0, 0.0
        for term in range(unknowns.shape[1]):
            slot, coefficient = unknowns[equation, term], coefficients[equation, term]
            residual -= coefficient * heights[slot]
            probed += coefficient * probe[slot]
            response += coefficient * answer[slot]
        square[equation] = information[equation] * residual * residual * correlated[equation]
        used += weights[equation] * information[equation] * probed * response
    return used


@compiled("int32[::1](int32[::1], int32[::1], int32[::1], float64[::1])")
def merge(starts: Array, ends: Array, columns: Array, entries: Array) -> Array:
    """Sort all rows by column, sum duplicates and close gaps; return the starts of the rows."""
    size = len(ends)
    first = np.zeros(size + 1, np.int32)
    filled = 0
    for row in range(size):
        begin = filled
        for index in range(starts[row], ends[row]):
            column, entry = columns[index], entries[index]
            slot = filled
            while slot > begin and columns[slot - 1] >= column:
                slot -= 1
            if slot < filled and columns[slot] == column:
                entries[slot] += entry
                continue
            for later in range(filled, slot, -1):
                columns[later], entries[later] = columns[later - 1], entries[later - 1]
            columns[slot], entries[slot] = column, entry
            filled += 1
        first[row + 1] = filled
    return first
