"""Robust plane fits to the inverse depths around every pixel: twin of ``fitted_planes``."""

import math

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled


@compiled(
    "void(float32[:,::1], boolean[:,::1], float64, int64, float64, float64, int64, "
    "float32[:,:,::1])"
)
def plane_fits(
    inverse_depth: NDArray[np.float32],
    valid: NDArray[np.bool_],
    step: float,
    radius: int,
    reach: float,
    ridge: float,
    iterations: int,
    fits: NDArray[np.float32],
) -> None:
    """Fit planes by reweighted least squares, in steps of inverse depth.

    Args:
        inverse_depth: Of a view.
        valid: Pixels that are used; only these get planes.
        step: Unit of the planes, inverse depth.
        radius: Of the windows, pixels.
        reach: Steps from the centre at which a pixel's first weight has fallen to 0.6.
        ridge: Added to the diagonal of the normal equations.
        iterations: Of fitting; from the second on a pixel's weight falls with its residual.
        fits: Filled in, ``5 height width``: the plane's offset from the pixel and its slopes,
            the variance round it, and the mean weight in the window. Elsewhere it stays.
    """
    height, width = inverse_depth.shape
    side = 2 * radius + 1
    count = side * side
    differences, weight = np.empty(count), np.empty(count)
    across_by, down_by = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    for index in range(count):
        across_by[index], down_by[index] = index % side - radius, index // side - radius
    for y in range(height):
        for x in range(width):
            if not valid[y, x]:
                continue
            centre = inverse_depth[y, x]
            for index in range(count):
                row, column = y + down_by[index], x + across_by[index]
                weight[index] = 0
                differences[index] = 0
                if 0 <= row < height and 0 <= column < width and valid[row, column]:
                    difference = (inverse_depth[row, column] - centre) / step
                    differences[index] = difference
                    weight[index] = math.exp(-((difference / reach) ** 2) / 2)
            offset = across = down = 0.0
            for _ in range(iterations):
                # Upper triangle of the normal equations for (1, u, v), and their right side.
                n, nu, nv, uu, uv, vv = ridge, 0.0, 0.0, ridge, 0.0, ridge
                b, bu, bv = 0.0, 0.0, 0.0
                for index in range(count):
                    w = weight[index]
                    u, v = across_by[index], down_by[index]
                    n += w
                    nu += w * u
                    nv += w * v
                    uu += w * (u * u)
                    uv += w * (u * v)
                    vv += w * (v * v)
                    weighted = w * differences[index]
                    b += weighted
                    bu += weighted * u
                    bv += weighted * v
                first, second, third = uu * vv - uv * uv, uv * nv - nu * vv, nu * uv - uu * nv
                determinant = n * first + nu * second + nv * third
                fourth, fifth, sixth = n * vv - nv * nv, nu * nv - n * uv, n * uu - nu * nu
                offset = (first * b + second * bu + third * bv) / determinant
                across = (second * b + fourth * bu + fifth * bv) / determinant
                down = (third * b + fifth * bu + sixth * bv) / determinant
                total = power = 0.0
                for index in range(count):
                    if weight[index] > 0:
                        u, v = across_by[index], down_by[index]
                        square = (differences[index] - offset - across * u - down * v) ** 2
                        w = math.exp(-square / 2)
                        weight[index] = w
                        total += w
                        power += w * square
            fits[0, y, x], fits[1, y, x], fits[2, y, x] = offset, across, down
            fits[3, y, x] = power / max(total, 1e-6)
            fits[4, y, x] = total / count
