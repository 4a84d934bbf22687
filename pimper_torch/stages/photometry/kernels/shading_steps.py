"""Gauss-Newton steps of samples on the cone: twin of ``stages.photometry.bilinear.update_shading``.

A sample has 14 values: its normal equations ``A``, ten packed entries, and ``b``. They are copied
to tiles of constant stride: only then can the compiler exclude aliasing and vectorize.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.twin_constants import MAX_STEP
from pimper_torch.stages.photometry.kernels.packed_patches import Numbers

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Three = tuple[float, float, float]
Four = tuple[float, float, float, float]
Six = tuple[float, float, float, float, float, float]
Ten = tuple[float, float, float, float, float, float, float, float, float, float]

# Samples of a tile: a choice, two cache lines of float32 a row.
TILE = 32

# Row and column of each entry of a packed matrix.
ROWS = (0, 0, 0, 0, 1, 1, 1, 2, 2, 3)
COLUMNS = (0, 1, 2, 3, 1, 2, 3, 2, 3, 3)

# As in ``stages.photometry.bilinear``, and as in ``stages.photometry.quadratics`` in float64.
_ROUNDING = 8 * float(np.finfo(np.float32).eps)
_TINY = float(np.finfo(np.float64).tiny) ** 0.5


@compiled(fast=True)
def matrices_of_samples(prior: Numbers, lights: Numbers, weight: Numbers, total: Numbers) -> None:
    """Write the packed ``A`` of every sample: its prior, and the sum of ``w l l^T`` over views."""
    for i in range(10):
        target, prior_row, row, column = total[i], prior[i], ROWS[i], COLUMNS[i]
        for k in range(len(target)):
            target[k] = prior_row[k]
        for f in range(len(lights)):
            weight_row, factor = weight[f], lights[f, row] * lights[f, column]
            for k in range(len(target)):
                target[k] += factor * weight_row[k]


@compiled(fast=True)
def matrix_at(rows: Numbers, k: int) -> Ten:
    """Return the packed matrix of a sample, a column of ten rows."""
    a, b, c, d, e = rows[0, k], rows[1, k], rows[2, k], rows[3, k], rows[4, k]
    return a, b, c, d, e, rows[5, k], rows[6, k], rows[7, k], rows[8, k], rows[9, k]


@compiled(fast=True)
def vector_at(rows: Numbers, k: int) -> Four:
    """Return the vector of a sample, a column of four rows."""
    return rows[0, k], rows[1, k], rows[2, k], rows[3, k]


@compiled(fast=True)
def update_shading(equations: Floats, shading: Floats, steps: int) -> None:
    """Take Gauss-Newton steps of every sample on the cone, in place.

    Args:
        equations: 14 rows: ``A`` and ``b``; a multiple of TILE samples.
        steps: Number of steps of each sample; those that increase its objective are rejected.
    """
    tile = np.empty(18 * TILE, np.float64)
    for first in range(0, shading.shape[1], TILE):
        load_tile(equations, shading, first, tile)
        for _ in range(steps):
            _step(tile)
        for row in range(4):
            target = shading[row]
            for k in range(TILE):
                target[first + k] = tile[(14 + row) * TILE + k]


@compiled()
def load_tile(equations: Floats, shading: Floats, first: int, tile: Doubles) -> None:
    """Copy equations and shading of a tile's samples."""
    for row in range(14):
        source = equations[row]
        for k in range(TILE):
            tile[row * TILE + k] = source[first + k]
    for row in range(4):
        source = shading[row]
        for k in range(TILE):
            tile[(14 + row) * TILE + k] = source[first + k]


@compiled(fast=True)
def _step(tile: Doubles) -> None:
    for k in range(TILE):
        a, b, s = read_sample(tile, k)
        image = apply(a, s)
        value = objective(s, image, b)
        moved = tangent_step(
            a, (b[0] - image[0], b[1] - image[1], b[2] - image[2], b[3] - image[3]), s
        )
        after = objective(moved, apply(a, moved), b)
        better = after <= value + _ROUNDING * abs(value)
        tile[14 * TILE + k] = moved[0] if better else s[0]
        tile[15 * TILE + k] = moved[1] if better else s[1]
        tile[16 * TILE + k] = moved[2] if better else s[2]
        tile[17 * TILE + k] = moved[3] if better else s[3]


@compiled(fast=True)
def read_sample(tile: Doubles, k: int) -> tuple[Ten, Four, Four]:
    """Return the ``A``, ``b`` and shading vector of a sample."""
    a = (
        tile[k],
        tile[TILE + k],
        tile[2 * TILE + k],
        tile[3 * TILE + k],
        tile[4 * TILE + k],
        tile[5 * TILE + k],
        tile[6 * TILE + k],
        tile[7 * TILE + k],
        tile[8 * TILE + k],
        tile[9 * TILE + k],
    )
    b = (tile[10 * TILE + k], tile[11 * TILE + k], tile[12 * TILE + k], tile[13 * TILE + k])
    s = (tile[14 * TILE + k], tile[15 * TILE + k], tile[16 * TILE + k], tile[17 * TILE + k])
    return a, b, s


@compiled(fast=True)
def apply(a: Ten, v: Four) -> Four:
    """Return the product of a packed matrix and a vector."""
    return (
        a[0] * v[0] + a[1] * v[1] + a[2] * v[2] + a[3] * v[3],
        a[1] * v[0] + a[4] * v[1] + a[5] * v[2] + a[6] * v[3],
        a[2] * v[0] + a[5] * v[1] + a[7] * v[2] + a[8] * v[3],
        a[3] * v[0] + a[6] * v[1] + a[8] * v[2] + a[9] * v[3],
    )


@compiled(fast=True)
def objective(s: Four, image: Four, b: Four) -> float:
    """Return ``s . (A s - 2 b)``."""
    return (
        s[0] * (image[0] - 2 * b[0])
        + s[1] * (image[1] - 2 * b[1])
        + s[2] * (image[2] - 2 * b[2])
        + s[3] * (image[3] - 2 * b[3])
    )


@compiled(fast=True)
def tangent_step(a: Ten, slope: Four, s: Four) -> Four:
    """Return ``s`` after the step ``(B^T A B)^-1 B^T slope`` along the cone, of bounded length."""
    n, first, second = frame(s)
    m = raised(congruence(a, n, first, second))
    inverse = inverse_factor(m)
    d = (
        slope[0] + slope[1] * n[0] + slope[2] * n[1] + slope[3] * n[2],
        slope[1] * first[0] + slope[2] * first[1] + slope[3] * first[2],
        slope[1] * second[0] + slope[2] * second[1] + slope[3] * second[2],
    )
    w0 = inverse[0] * d[0]
    w1 = inverse[1] * d[0] + inverse[2] * d[1]
    w2 = inverse[3] * d[0] + inverse[4] * d[1] + inverse[5] * d[2]
    y0 = inverse[0] * w0 + inverse[1] * w1 + inverse[3] * w2
    y1 = inverse[2] * w1 + inverse[4] * w2
    y2 = inverse[5] * w2
    length = math.sqrt(y0 * y0 + y1 * y1 + y2 * y2)
    limit = MAX_STEP * s[0]
    shrink = limit / max(length, 1e-30)
    shrink = shrink if length > limit else 1.0
    y0, y1, y2 = shrink * y0, shrink * y1, shrink * y2
    return project_to_cone(
        s[0] + y0,
        s[1] + n[0] * y0 + first[0] * y1 + second[0] * y2,
        s[2] + n[1] * y0 + first[1] * y1 + second[1] * y2,
        s[3] + n[2] * y0 + first[2] * y1 + second[2] * y2,
    )


@compiled(fast=True)
def project_to_cone(b: float, x: float, y: float, z: float) -> Four:
    """Return the nearest vector of the cone; see ``stages.photometry.cone.project_to_cone``."""
    square = x * x + y * y + z * z
    length = math.sqrt(square if square > 0 else 1.0)
    albedo = max(b + length, 0.0) / 2
    albedo = albedo if square > 0 else 0.0
    ratio = albedo / length
    return albedo, x * ratio, y * ratio, z * ratio


@compiled(fast=True)
def frame(s: Four) -> tuple[Three, Three, Three]:
    """Return the normal, zero at the apex, and two tangents; see ``stages.photometry.cone``."""
    square = s[1] * s[1] + s[2] * s[2] + s[3] * s[3]
    inverse = 1 / math.sqrt(square if square > 0 else 1.0)
    x, y, z = s[1] * inverse, s[2] * inverse, s[3] * inverse
    sign = 1.0 if z >= 0 else -1.0
    p = -1 / (sign + z)
    q = x * y * p
    return (
        (x, y, z),
        (1 + sign * x * x * p, sign * q, -sign * x),
        (q, sign + y * y * p, -y),
    )


@compiled(fast=True)
def congruence(a: Ten, n: Three, first: Three, second: Three) -> Six:
    """Return ``B^T A B``, packed, for the columns ``(1, n)``, ``(0, first)``, ``(0, second)``."""
    u = apply(a, (0.0, first[0], first[1], first[2]))
    v = apply(a, (0.0, second[0], second[1], second[2]))
    w = apply(a, (1.0, n[0], n[1], n[2]))
    return (
        w[0] + n[0] * w[1] + n[1] * w[2] + n[2] * w[3],
        u[0] + n[0] * u[1] + n[1] * u[2] + n[2] * u[3],
        v[0] + n[0] * v[1] + n[1] * v[2] + n[2] * v[3],
        first[0] * u[1] + first[1] * u[2] + first[2] * u[3],
        first[0] * v[1] + first[1] * v[2] + first[2] * v[3],
        second[0] * v[1] + second[1] * v[2] + second[2] * v[3],
    )


@compiled(fast=True)
def raised(m: Six) -> Six:
    """Return the matrix with an increased diagonal, so that it can be inverted."""
    more = 1e-9 * (m[0] + m[3] + m[5])
    return m[0] + more, m[1], m[2], m[3] + more, m[4], m[5] + more


@compiled(fast=True)
def inverse_factor(m: Six) -> Six:
    """Return ``C^-1`` by rows, with ``m = C C^T``; see ``quadratics.PackedCholesky``."""
    floor = max(1e-12 * (m[0] + m[3] + m[5]), _TINY)
    c00 = 1 / math.sqrt(max(m[0], floor))
    c10, c20 = m[1] * c00, m[2] * c00
    c11 = 1 / math.sqrt(max(m[3] - c10 * c10, floor))
    c21 = (m[4] - c20 * c10) * c11
    c22 = 1 / math.sqrt(max(m[5] - c20 * c20 - c21 * c21, floor))
    i10 = -c10 * c00 * c11
    i21 = -c21 * c11 * c22
    i20 = -(c20 * c00 + c21 * i10) * c22
    return c00, i10, c11, i20, i21, c22


@compiled(fast=True)
def whitening(equations: Floats, shading: Floats, vectors: Floats) -> None:
    """Compute the rows of ``C^-1 B^T``: times lights and weights they are whitened derivatives.

    Args:
        vectors: Result, 12 rows: three vectors of four.
    """
    tile, whitened = np.empty(18 * TILE, np.float64), np.empty(12 * TILE, np.float64)
    for start in range(0, shading.shape[1], TILE):
        load_tile(equations, shading, start, tile)
        for k in range(TILE):
            a, _, s = read_sample(tile, k)
            n, first, second = frame(s)
            inverse = inverse_factor(congruence(a, n, first, second))
            whitened[k] = inverse[0]
            whitened[4 * TILE + k] = inverse[1]
            whitened[8 * TILE + k] = inverse[3]
            for i in range(3):
                whitened[(1 + i) * TILE + k] = inverse[0] * n[i]
                whitened[(5 + i) * TILE + k] = inverse[1] * n[i] + inverse[2] * first[i]
                whitened[(9 + i) * TILE + k] = (
                    inverse[3] * n[i] + inverse[4] * first[i] + inverse[5] * second[i]
                )
        for row in range(12):
            target = vectors[row]
            for k in range(TILE):
                target[start + k] = whitened[row * TILE + k]
