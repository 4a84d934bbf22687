"""Bilinear interpolation in one level of a pyramid, and the levels of a footprint."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pimper_torch.ground.kernels.compile import compiled

Array = NDArray[Any]


@compiled()
def corners(height: int, width: int, x: float, y: float) -> tuple[int, int, int, float, float]:
    """Return the upper left one of the four pixels around a point, and bilinear weights.

    Args:
        x: To the right, counted from the first pixel's centre; clamped to the border.

    Returns:
        An index, the steps to the pixels at the right and below (0 at the border), and the
        weights of these.
    """
    # NaN compares false, and is clamped to the border too.
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
def bilinear(pixels: Array, at: int, right: int, below: int, across: float, down: float) -> float:
    """Blend four pixels of a row as :func:`corners` gives them."""
    here, beside = np.float32(pixels[at]), np.float32(pixels[at + right])
    above = here + across * (beside - here)
    at += below
    here, beside = np.float32(pixels[at]), np.float32(pixels[at + right])
    blended: Any = above + down * (here + across * (beside - here) - above)
    return blended


@compiled("float64[:,::1](int64[:,::1])")
def shrinkage(levels: Array) -> Array:
    """Return each level's height and width as fractions of the finest one's."""
    fractions = np.empty((len(levels), 2), np.float64)
    for level in range(len(levels)):
        for axis in range(2):
            fractions[level, axis] = levels[level, axis] / levels[0, axis]
    return fractions
