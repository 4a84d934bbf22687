"""Residuals of a packed patch, their deviation, and the weights of its loss."""

import math
from typing import Any

import numpy as np

from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.robust_scale import robust_variance
from pimper_torch.kernels.twin_constants import CAUCHY, GEMAN_MCCLURE, HUBER, SQUARES
from pimper_torch.stages.photometry.kernels.packed_patches import Numbers, Patch

Kind = type[np.float32] | type[np.float64]


@compiled(fast=True)
def compute(patch: Patch, lights: Numbers, shading: Numbers) -> None:
    """Write the residuals of all entries to the patch."""
    s, x, y, z = shading[0], shading[1], shading[2], shading[3]
    for f in range(len(lights)):
        radiance, residual, light = patch.radiance[f], patch.residual[f], lights[f]
        for k in range(len(residual)):
            residual[k] = radiance[k] - (
                light[0] * s[k] + light[1] * x[k] + light[2] * y[k] + light[3] * z[k]
            )


@compiled(fast=True)
def _deviation(patch: Patch, guess: float, kind: Kind) -> tuple[float, float]:
    squares = np.empty(len(patch.residual) * patch.num_scale, kind)
    count = 0
    for f in range(len(patch.residual)):
        residual, given = patch.residual[f], patch.given[f]
        for k in range(patch.num_scale):
            squares[count] = residual[k] * residual[k]
            count += given[k] > 0
    variance, scale = robust_variance(squares[:count], guess, kind)
    return max(math.sqrt(variance), patch.min_deviation), scale


@compiled(fast=True)
def weighed(loss: int, given: float, square: float, one: float) -> tuple[float, float]:
    """Return a weight times the loss's, and its derivative by the squared relative residual.

    Args:
        one: 1 in the type of the others.
    """
    if loss == CAUCHY:
        weight = given / (one + square)
        return weight, -weight / (one + square)
    if loss == GEMAN_MCCLURE:
        root = one / (one + square)
        weight = given * root * root
        return weight, -(weight + weight) * root
    if loss == HUBER and square > one:
        weight = given / np.sqrt(square)
        return weight, -weight / (square + square)
    return given, one - one


@compiled(fast=True)
def update_weights(
    patch: Patch, lights: Numbers, shading: Numbers, guess: float, kind: Kind
) -> tuple[float, float]:
    """Update residuals and robust weights; return the residuals' deviation and squared scale.

    The deviation is at least its minimum. It is 0 for squares, whose weights are constant.

    Args:
        guess: Initial squared scale: that of an earlier call, or 0.
        kind: Type of the residuals.
    """
    compute(patch, lights, shading)
    deviation, scale = _deviation(patch, guess, kind) if patch.loss != SQUARES else (0.0, 0.0)
    width = patch.scale * deviation
    one: Any = kind(1)
    inverse = kind(1 / width if width > 0 else 0.0)
    for f in range(len(lights)):
        residual, given, weight = patch.residual[f], patch.given[f], patch.weight[f]
        for k in range(len(residual)):
            relative = residual[k] * inverse
            weight[k] = weighed(patch.loss, given[k], relative * relative, one)[0]
    return deviation, scale


@compiled(fast=True)
def weighted_square(weight: Numbers, values: Numbers) -> tuple[float, float]:
    """Return the weighted sum of squares, and the sum of the weights."""
    total, count = 0.0, 0.0
    for f in range(len(values)):
        weight_row, row = weight[f], values[f]
        for k in range(len(row)):
            total += weight_row[k] * row[k] * row[k]
            count += weight_row[k]
    return total, count


@compiled(fast=True)
def residual_size(patch: Patch) -> tuple[float, float]:
    """Return the root mean square of the patch's residuals, 0 without data, and their weight."""
    total, count = weighted_square(patch.given, patch.residual)
    return (math.sqrt(total / count) if count > 0 else 0.0), count
