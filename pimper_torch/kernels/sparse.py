"""Products with sparse matrices in compressed rows, fused with what multigrid does with them.

Vectors have one column a right-hand side, so that a matrix is read once for all of them. Every
function works on the rows from ``first`` up to ``last`` alone. Sums are float64 in either type.
"""

import numpy as np

from pimper_torch.kernels.switch import compiled

Array = np.ndarray

_REALS = ("float32", "float64")


def _types(pattern: str) -> list[str]:
    """Spell out a signature of matrices M, vectors V and diagonals D in both types."""
    return [
        pattern.replace("M", "int32[::1], int32[::1], D")
        .replace("V", f"{real}[:,::1]")
        .replace("D", f"{real}[::1]")
        for real in _REALS
    ]


@compiled(*_types("void(M, V, V, V, float64, float64, int64, int64)"))
def product(
    starts: Array,
    columns: Array,
    entries: Array,
    vectors: Array,
    start: Array,
    found: Array,
    keep: float,
    gain: float,
    first: int,
    last: int,
) -> None:
    """Write ``keep * start + gain * A @ vectors`` to ``found``, which may be ``start``.

    Where ``keep`` is 0, the start is not read.
    """
    if keep == 0:
        for row in range(first, last):
            found[row] = 0.0
        start, keep = found, 1.0
    width = vectors.shape[1]
    if width == 1:
        for row in range(first, last):
            one = 0.0
            for place in range(starts[row], starts[row + 1]):
                one += entries[place] * vectors[columns[place], 0]
            found[row, 0] = keep * start[row, 0] + gain * one
    elif width == 2:
        for row in range(first, last):
            one, two = 0.0, 0.0
            for place in range(starts[row], starts[row + 1]):
                column, entry = columns[place], entries[place]
                one += entry * vectors[column, 0]
                two += entry * vectors[column, 1]
            found[row, 0] = keep * start[row, 0] + gain * one
            found[row, 1] = keep * start[row, 1] + gain * two
    else:
        for row in range(first, last):
            for side in range(width):
                one = 0.0
                for place in range(starts[row], starts[row + 1]):
                    one += entries[place] * vectors[columns[place], side]
                found[row, side] = keep * start[row, side] + gain * one


@compiled(*_types("void(D, V, V, float64, int64, int64)"))
def scaled(
    inverse_diagonal: Array, residual: Array, step: Array, fraction: float, first: int, last: int
) -> None:
    """Write ``share * D^-1 residual`` to ``step``."""
    for row in range(first, last):
        for side in range(residual.shape[1]):
            step[row, side] = fraction * inverse_diagonal[row] * residual[row, side]


@compiled(*_types("void(M, D, V, V, V, V, float64, float64, int64, int64)"))
def corrected(
    starts: Array,
    columns: Array,
    entries: Array,
    inverse_diagonal: Array,
    residual: Array,
    step: Array,
    start: Array,
    found: Array,
    of_step: float,
    of_rest: float,
    first: int,
    last: int,
) -> None:
    """Write ``start + of_step * step + of_rest * D^-1 (residual - A @ step)`` to ``found``.

    ``found`` may be ``start`` or ``residual``, but not ``step``.
    """
    width = step.shape[1]
    if width == 1:
        for row in range(first, last):
            rest = float(residual[row, 0])
            for place in range(starts[row], starts[row + 1]):
                rest -= entries[place] * step[columns[place], 0]
            found[row, 0] = (
                start[row, 0] + of_step * step[row, 0] + of_rest * inverse_diagonal[row] * rest
            )
    elif width == 2:
        for row in range(first, last):
            rest, more = float(residual[row, 0]), float(residual[row, 1])
            for place in range(starts[row], starts[row + 1]):
                column, entry = columns[place], entries[place]
                rest -= entry * step[column, 0]
                more -= entry * step[column, 1]
            gain = of_rest * inverse_diagonal[row]
            found[row, 0] = start[row, 0] + of_step * step[row, 0] + gain * rest
            found[row, 1] = start[row, 1] + of_step * step[row, 1] + gain * more
    else:
        for row in range(first, last):
            gain = of_rest * inverse_diagonal[row]
            for side in range(width):
                rest = float(residual[row, side])
                for place in range(starts[row], starts[row + 1]):
                    rest -= entries[place] * step[columns[place], side]
                found[row, side] = start[row, side] + of_step * step[row, side] + gain * rest
