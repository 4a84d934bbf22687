"""Products with sparse matrices in compressed rows, fused with the updates of multigrid.

Vectors have one column per right-hand side. Every function computes the rows ``first:last``. Sums
are float64 for both types. One and two columns have separate loops: a loop over columns took 1.1 to
1.3 and 1.9 times as long (five-point Laplacian, 130,000 unknowns).
"""

import numpy as np

from pimper_torch.kernels.compile import compiled

Array = np.ndarray

_REALS = ("float32", "float64")


def _types(pattern: str) -> list[str]:
    """Return the signatures of a pattern of matrices M, vectors V and diagonals D in both types."""
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
    out: Array,
    keep: float,
    gain: float,
    first: int,
    last: int,
) -> None:
    """Write ``keep * start + gain * A @ vectors`` to ``out``, which may be ``start``.

    If ``keep`` is 0, the start is not read.
    """
    if keep == 0:
        for row in range(first, last):
            out[row] = 0.0
        start, keep = out, 1.0
    width = vectors.shape[1]
    if width == 1:
        for row in range(first, last):
            total = 0.0
            for index in range(starts[row], starts[row + 1]):
                total += entries[index] * vectors[columns[index], 0]
            out[row, 0] = keep * start[row, 0] + gain * total
    elif width == 2:
        for row in range(first, last):
            total, second_total = 0.0, 0.0
            for index in range(starts[row], starts[row + 1]):
                column, entry = columns[index], entries[index]
                total += entry * vectors[column, 0]
                second_total += entry * vectors[column, 1]
            out[row, 0] = keep * start[row, 0] + gain * total
            out[row, 1] = keep * start[row, 1] + gain * second_total
    else:
        for row in range(first, last):
            for side in range(width):
                total = 0.0
                for index in range(starts[row], starts[row + 1]):
                    total += entries[index] * vectors[columns[index], side]
                out[row, side] = keep * start[row, side] + gain * total


@compiled(*_types("void(D, V, V, float64, int64, int64)"))
def jacobi_step(
    inverse_diagonal: Array, residual: Array, step: Array, fraction: float, first: int, last: int
) -> None:
    """Write ``fraction * D^-1 residual`` to ``step``."""
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
    out: Array,
    of_step: float,
    of_rest: float,
    first: int,
    last: int,
) -> None:
    """Write ``start + of_step * step + of_rest * D^-1 (residual - A @ step)`` to ``out``.

    ``out`` may be ``start`` or ``residual``, but not ``step``.
    """
    width = step.shape[1]
    if width == 1:
        for row in range(first, last):
            value = float(residual[row, 0])
            for index in range(starts[row], starts[row + 1]):
                value -= entries[index] * step[columns[index], 0]
            out[row, 0] = (
                start[row, 0] + of_step * step[row, 0] + of_rest * inverse_diagonal[row] * value
            )
    elif width == 2:
        for row in range(first, last):
            value, second_value = float(residual[row, 0]), float(residual[row, 1])
            for index in range(starts[row], starts[row + 1]):
                column, entry = columns[index], entries[index]
                value -= entry * step[column, 0]
                second_value -= entry * step[column, 1]
            gain = of_rest * inverse_diagonal[row]
            out[row, 0] = start[row, 0] + of_step * step[row, 0] + gain * value
            out[row, 1] = start[row, 1] + of_step * step[row, 1] + gain * second_value
    else:
        for row in range(first, last):
            gain = of_rest * inverse_diagonal[row]
            for side in range(width):
                value = float(residual[row, side])
                for index in range(starts[row], starts[row + 1]):
                    value -= entries[index] * step[columns[index], side]
                out[row, side] = start[row, side] + of_step * step[row, side] + gain * value
