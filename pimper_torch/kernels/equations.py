"""Normal equations of sparse least squares, straight into compressed rows."""

import numpy as np

from pimper_torch.kernels.switch import compiled

Array = np.ndarray

_REALS = ("float32", "float64")
_FOUND = "Tuple((int32[::1], int32[::1], float64[::1]))"


@compiled("void(int64[:,::1], int32[::1])")
def count(unknowns: Array, counts: Array) -> None:
    """Add up how many entries each row gets, those that come twice counted twice."""
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
    """Write the entries of equations where their rows end by now, and move the ends on."""
    terms = unknowns.shape[1]
    for equation in range(len(unknowns)):
        for one in range(terms):
            row = unknowns[equation, one]
            scaled = weights[equation] * coefficients[equation, one]
            for other in range(terms):
                at = ends[row]
                columns[at] = unknowns[equation, other]
                entries[at] = scaled * coefficients[equation, other]
                ends[row] = at + 1


@compiled(
    *(
        f"void(int64[:,::1], {real}[:,::1], {real}[::1], float64[::1], float64[::1])"
        for real in _REALS
    )
)
def add_sides(
    unknowns: Array, coefficients: Array, targets: Array, weights: Array, side: Array
) -> None:
    """Add what equations ask for to the right-hand side."""
    for equation in range(len(unknowns)):
        asked = weights[equation] * targets[equation]
        for term in range(unknowns.shape[1]):
            side[unknowns[equation, term]] += coefficients[equation, term] * asked


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
    """Write squared residuals in units of what is claimed; give what a probe sees used up."""
    used = 0.0
    for equation in range(len(unknowns)):
        left, asked, told = float(targets[equation]), 0.0, 0.0
        for term in range(unknowns.shape[1]):
            at, coefficient = unknowns[equation, term], coefficients[equation, term]
            left -= coefficient * heights[at]
            asked += coefficient * probe[at]
            told += coefficient * answer[at]
        square[equation] = information[equation] * left * left * correlated[equation]
        used += weights[equation] * information[equation] * asked * told
    return used


@compiled(f"{_FOUND}(int32[::1], int32[::1], int32[::1], float64[::1])")
def merged(
    starts: Array, ends: Array, columns: Array, entries: Array
) -> tuple[Array, Array, Array]:
    """Sort every row, and add up entries that come twice."""
    size = len(ends)
    first = np.zeros(size + 1, np.int32)
    filled = 0
    for row in range(size):
        begin = filled
        for place in range(starts[row], ends[row]):
            column, entry = columns[place], entries[place]
            at = filled
            while at > begin and columns[at - 1] >= column:
                at -= 1
            if at < filled and columns[at] == column:
                entries[at] += entry
                continue
            for later in range(filled, at, -1):
                columns[later], entries[later] = columns[later - 1], entries[later - 1]
            columns[at], entries[at] = column, entry
            filled += 1
        first[row + 1] = filled
    return first, columns[:filled].copy(), entries[:filled].copy()
