"""Robust scale of residuals: twin of ``linalg.robust.robust_variance``."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.twin_constants import (
    GAUSSIAN_SCALE,
    LONGEST_NEWTON_STEP,
    NEWTON_STEPS,
)

Floats = NDArray[Any]
Kind = type[np.float32] | type[np.float64]

# Length of the Newton step that ends the iteration.
_CLOSE = float(np.finfo(np.float32).eps) ** 0.75


@compiled(fast=True)
def robust_variance(squares: Floats, guess: float, kind: Kind) -> tuple[float, float]:
    """Estimate the variance from squared residuals, robustly.

    Args:
        guess: Initial squared scale: that of an earlier call, or 0 for the mean square.
        kind: Type of the sums.

    Returns:
        The variance, 0 if at least half of the squares are 0, and the squared scale.
    """
    half = 0.5 * len(squares)
    total, num_positive = 0.0, 0
    for i in range(len(squares)):
        total += squares[i]
        num_positive += squares[i] > 0
    if not num_positive > half:
        return 0.0, 0.0
    scale = guess if guess > 0 else total / len(squares)
    for _ in range(NEWTON_STEPS):
        fraction, slope = _fractions(squares, 1 / scale, kind)
        step = (fraction - half) / max(slope, 1e-7)
        scale *= math.exp(min(max(step, -LONGEST_NEWTON_STEP), LONGEST_NEWTON_STEP))
        if abs(step) < _CLOSE:
            break
    fraction, slope = _fractions(squares, 1 / scale, kind)
    correction = (fraction - half) / slope if slope > 0 else 0.0
    return max(scale * (1 + correction), 0.0) / GAUSSIAN_SCALE**2, scale


@compiled(fast=True)
def _fractions(squares: Floats, inverse: float, kind: Kind) -> tuple[float, float]:
    """Return the sum of ``r^4 / (r^4 + t^4)``, and minus its derivative by ``log(t^2)``."""
    one, most, per = kind(1), kind(1e9), kind(inverse)
    fraction, square = kind(0), kind(0)
    for i in range(len(squares)):
        ratio = min(squares[i] * per, most)
        ratio *= ratio
        value = ratio / (one + ratio)
        fraction += value
        square += value * value
    return float(fraction), 2 * (float(fraction) - float(square))
