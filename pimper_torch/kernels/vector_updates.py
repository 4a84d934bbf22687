"""Fused vector updates of conjugate gradients, in place.

Vectors have one column per right-hand side, in float64; those of the preconditioner may be float32.
"""

import numpy as np

from pimper_torch.kernels.compile import compiled

Array = np.ndarray

# Rows of a block: sums of blocks do not depend on the number of threads.
BLOCK = 4096

_WIDE = "float64[:,::1]"
_REALS = ("float32[:,::1]", "float64[:,::1]")


@compiled(*(f"void({_WIDE}, {real}, {_WIDE}, int64, int64)" for real in _REALS))
def dots(a: Array, b: Array, sums: Array, first: int, last: int) -> None:
    """Write the inner products of the blocks ``first:last`` of rows."""
    for block in range(first, last):
        for column in range(a.shape[1]):
            total = 0.0
            for row in range(block * BLOCK, min((block + 1) * BLOCK, len(a))):
                total += a[row, column] * b[row, column]
            sums[block, column] = total


@compiled(
    *(
        f"void({_WIDE}, {_WIDE}, {_WIDE}, {_WIDE}, float64[::1], {real}, int64, int64)"
        for real in _REALS
    )
)
def step(
    solution: Array,
    residual: Array,
    direction: Array,
    image: Array,
    step_length: Array,
    rounded: Array,
    first: int,
    last: int,
) -> None:
    """Update solution and residual along the directions; write the residual to ``rounded``, too."""
    for row in range(first, last):
        for column in range(len(step_length)):
            solution[row, column] += step_length[column] * direction[row, column]
            remaining = residual[row, column] - step_length[column] * image[row, column]
            residual[row, column] = remaining
            rounded[row, column] = remaining


@compiled(*(f"void({_WIDE}, {real}, float64[::1], int64, int64)" for real in _REALS))
def new_direction(direction: Array, z: Array, beta: Array, first: int, last: int) -> None:
    """Set the directions to ``z + beta * direction``, with the preconditioned residual ``z``."""
    for row in range(first, last):
        for column in range(len(beta)):
            direction[row, column] = z[row, column] + beta[column] * direction[row, column]
