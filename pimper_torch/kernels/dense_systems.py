"""Dense systems of a few hundred unknowns, solved in the calling thread.

LAPACK would be as fast, but starts threads at these sizes.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled

Doubles = NDArray[np.float64]


@compiled(fast=True)
def solve_damped(matrix: Doubles, ridge: float, rhs: Doubles, factor: Doubles) -> bool:
    """Solve ``(matrix + ridge) x = rhs`` in place by Cholesky's factorization ``U^T U``.

    Args:
        matrix: Its upper triangle; the size is a multiple of 4.
        ridge: Added to the diagonal.
        rhs: Replaced by the solution.
        factor: Workspace for ``U``.

    Returns:
        Whether the damped matrix is positive definite; if not, ``rhs`` is undefined.
    """
    size = len(matrix)
    for i in range(size):
        source, target = matrix[i], factor[i]
        for j in range(i, size):
            target[j] = source[j]
        target[i] += ridge
    for first in range(0, size, 4):
        for i in range(first, first + 4):
            row = factor[i]
            if not row[i] > 0:
                return False
            inverse = 1 / math.sqrt(row[i])
            for j in range(i, size):
                row[j] *= inverse
            for below in range(i + 1, first + 4):
                _subtract(factor[below], row, row[below], below)
        a, b, c, d = factor[first], factor[first + 1], factor[first + 2], factor[first + 3]
        for i in range(first + 4, size):
            row = factor[i]
            p, q, r, s = a[i], b[i], c[i], d[i]
            for j in range(i, size):
                row[j] -= p * a[j] + q * b[j] + r * c[j] + s * d[j]
    for i in range(size):
        rhs[i] /= factor[i, i]
        _subtract(rhs, factor[i], rhs[i], i + 1)
    for i in range(size - 1, -1, -1):
        row = factor[i]
        total = 0.0
        for j in range(i + 1, size):
            total += row[j] * rhs[j]
        rhs[i] = (rhs[i] - total) / row[i]
    return True


@compiled(fast=True)
def _subtract(target: Doubles, row: Doubles, by: float, first: int) -> None:
    for j in range(first, len(row)):
        target[j] -= by * row[j]


@compiled(fast=True)
def eliminate(matrix: Doubles, rhs: Doubles) -> bool:
    """Solve ``matrix x = rhs`` by elimination with partial pivoting; both are overwritten.

    Args:
        rhs: Replaced by the solutions, one a column.

    Returns:
        Whether the matrix is regular; if not, ``rhs`` is undefined.
    """
    size, columns = rhs.shape
    for i in range(size):
        pivot = i
        for r in range(i + 1, size):
            if abs(matrix[r, i]) > abs(matrix[pivot, i]):
                pivot = r
        if not abs(matrix[pivot, i]) > 0:
            return False
        for j in range(i, size):
            matrix[i, j], matrix[pivot, j] = matrix[pivot, j], matrix[i, j]
        for j in range(columns):
            rhs[i, j], rhs[pivot, j] = rhs[pivot, j], rhs[i, j]
        for r in range(i + 1, size):
            factor = matrix[r, i] / matrix[i, i]
            if factor != 0:
                _subtract(matrix[r], matrix[i], factor, i + 1)
                _subtract(rhs[r], rhs[i], factor, 0)
    for i in range(size - 1, -1, -1):
        for r in range(i + 1, size):
            _subtract(rhs[i], rhs[r], matrix[i, r], 0)
        for j in range(columns):
            rhs[i, j] /= matrix[i, i]
    return True
