"""Bilinear interpolation in one level of a pyramid, and the pyramid levels of a footprint."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled

Array = NDArray[Any]


@compiled()
def corners(height: int, width: int, x: float, y: float) -> tuple[int, int, int, float, float]:
    """Return the four pixels around a point, and their bilinear weights.

    Args:
        x: To the right, counted from the first pixel's centre; clamped to the border.

    Returns:
        Index of the upper left pixel; steps to right and lower pixels, 0 at the border; weights.
    """
    # NaN compares false, and is also clamped to the border.
    x = min(x, width - 1.0) if x > 0 else 0.0
    y = min(y, height - 1.0) if y > 0 else 0.0
    column, row = int(x), int(y)
    right = 1 if column < width - 1 else 0
    below = width if row < height - 1 else 0
    across: Any = np.float32(x - column)
    down: Any = np.float32(y - row)
    return row * width + column, right, below, across, down


@compiled("Tuple((int64, float32))(float64, int64)")
def blended_level(squared_footprint: float, count: int) -> tuple[int, float]:
    """Return the finer of the two levels around a footprint, and the weight of the coarser one.

    Args:
        squared_footprint: Area of the footprint, pixels of the finest level.
    """
    if squared_footprint <= 1:
        return 0, 0.0
    level = min(0.5 * math.log2(squared_footprint), count - 1.0)
    finer = int(level)
    return finer, level - finer


@compiled()
def bilinear(pixels: Array, i: int, right: int, below: int, across: float, down: float) -> float:
    """Interpolate four pixels of a flat image, given by the results of :func:`corners`."""
    first, second = np.float32(pixels[i]), np.float32(pixels[i + right])
    above = first + across * (second - first)
    i += below
    first, second = np.float32(pixels[i]), np.float32(pixels[i + right])
    value: Any = above + down * (first + across * (second - first) - above)
    return value


@compiled("float64[:,::1](int64[:,::1])")
def shrinkage(levels: Array) -> Array:
    """Return each level's height and width as fractions of the finest one's."""
    fractions = np.empty((len(levels), 2), np.float64)
    for level in range(len(levels)):
        for axis in range(2):
            fractions[level, axis] = levels[level, axis] / levels[0, axis]
    return fractions
