"""The vectors of conjugate gradients, updated in place, in as few passes as they need.

They have one column a right-hand side, in float64; what multigrid takes and gives may be in
float32.
"""

import numpy as np

from pimper_torch.kernels.switch import compiled

Array = np.ndarray

# Rows whose products are added up together: sums do not depend on how many threads take part.
BLOCK = 4096

_WIDE = "float64[:,::1]"
_REALS = ("float32[:,::1]", "float64[:,::1]")


@compiled(*(f"void({_WIDE}, {real}, {_WIDE}, int64, int64)" for real in _REALS))
def dots(one: Array, other: Array, sums: Array, first: int, last: int) -> None:
    """Write the inner products of the blocks of rows from ``first`` up to ``last``."""
    for block in range(first, last):
        for side in range(one.shape[1]):
            total = 0.0
            for row in range(block * BLOCK, min((block + 1) * BLOCK, len(one))):
                total += one[row, side] * other[row, side]
            sums[block, side] = total


@compiled(
    *(
        f"void({_WIDE}, {_WIDE}, {_WIDE}, {_WIDE}, float64[::1], {real}, int64, int64)"
        for real in _REALS
    )
)
def moved(
    found: Array,
    residual: Array,
    direction: Array,
    image: Array,
    length: Array,
    rounded: Array,
    first: int,
    last: int,
) -> None:
    """Go along the directions by ``length``, and round the residual that is left."""
    for row in range(first, last):
        for side in range(len(length)):
            found[row, side] += length[side] * direction[row, side]
            left = residual[row, side] - length[side] * image[row, side]
            residual[row, side] = left
            rounded[row, side] = left


@compiled(*(f"void({_WIDE}, {real}, float64[::1], int64, int64)" for real in _REALS))
def rotated(direction: Array, better: Array, growth: Array, first: int, last: int) -> None:
    """Make the directions ``better + growth * direction``."""
    for row in range(first, last):
        for side in range(len(growth)):
            direction[row, side] = better[row, side] + growth[side] * direction[row, side]
