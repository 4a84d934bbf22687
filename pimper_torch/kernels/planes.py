"""Planes through the inverse depths round every pixel: the twin of ``fitted_planes``."""

import math

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.switch import compiled


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
        valid: Which pixels count; only these get planes.
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
    around, weight = np.empty(count), np.empty(count)
    across_by, down_by = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    for place in range(count):
        across_by[place], down_by[place] = place % side - radius, place // side - radius
    for y in range(height):
        for x in range(width):
            if not valid[y, x]:
                continue
            centre = inverse_depth[y, x]
            for place in range(count):
                row, column = y + down_by[place], x + across_by[place]
                weight[place] = 0
                around[place] = 0
                if 0 <= row < height and 0 <= column < width and valid[row, column]:
                    away = (inverse_depth[row, column] - centre) / step
                    around[place] = away
                    weight[place] = math.exp(-((away / reach) ** 2) / 2)
            offset = across = down = 0.0
            for _ in range(iterations):
                # Upper triangle of the normal equations for (1, u, v), and their right side.
                n, nu, nv, uu, uv, vv = ridge, 0.0, 0.0, ridge, 0.0, ridge
                b, bu, bv = 0.0, 0.0, 0.0
                for place in range(count):
                    w = weight[place]
                    u, v = across_by[place], down_by[place]
                    n += w
                    nu += w * u
                    nv += w * v
                    uu += w * (u * u)
                    uv += w * (u * v)
                    vv += w * (v * v)
                    told = w * around[place]
                    b += told
                    bu += told * u
                    bv += told * v
                first, second, third = uu * vv - uv * uv, uv * nv - nu * vv, nu * uv - uu * nv
                whole = n * first + nu * second + nv * third
                fourth, fifth, sixth = n * vv - nv * nv, nu * nv - n * uv, n * uu - nu * nu
                offset = (first * b + second * bu + third * bv) / whole
                across = (second * b + fourth * bu + fifth * bv) / whole
                down = (third * b + fifth * bu + sixth * bv) / whole
                total = power = 0.0
                for place in range(count):
                    if weight[place] > 0:
                        u, v = across_by[place], down_by[place]
                        square = (around[place] - offset - across * u - down * v) ** 2
                        w = math.exp(-square / 2)
                        weight[place] = w
                        total += w
                        power += w * square
            fits[0, y, x], fits[1, y, x], fits[2, y, x] = offset, across, down
            fits[3, y, x] = power / max(total, 1e-6)
            fits[4, y, x] = total / count
