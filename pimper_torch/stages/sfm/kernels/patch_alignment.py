"""Alignment of a view's patches with templates."""

from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels import signatures
from pimper_torch.kernels.compile import compiled

Array = NDArray[Any]


class PatchTemplates(NamedTuple):
    """Templates without changes of light, slopes, and inverses of the slopes' normal matrices."""

    values: signatures.Floats2
    slopes: signatures.Floats3
    inverse: signatures.Floats3


class PatchWindow(NamedTuple):
    """Homogeneous steps in the plane, root weights, and orthonormal columns: changes of light."""

    offsets: signatures.Floats2
    root: signatures.Floats1
    light: signatures.Floats2


class Alignment(NamedTuple):
    """Results of an alignment.

    Attributes:
        shift: Along the plane; infinite if the patch was lost or did not converge.
        deviation: Standard deviation of the point along its worst direction, in steps.
        correlation: With the template.
    """

    shift: signatures.Doubles2
    deviation: signatures.Doubles1
    correlation: signatures.Doubles1


@compiled(fast=True)
def _sample_patch(
    log: Array, h: Array, along: float, across: float, window: PatchWindow, patch: Array
) -> None:
    """Sample a patch at a shift along the plane, weighted, with changes of light projected out."""
    height, width = log.shape
    offsets, root, light = window
    center_x = h[0, 2] + h[0, 0] * along + h[0, 1] * across
    center_y = h[1, 2] + h[1, 0] * along + h[1, 1] * across
    center_z = h[2, 2] + h[2, 0] * along + h[2, 1] * across
    for s in range(len(patch)):
        u, v = offsets[0, s], offsets[1, s]
        z = center_z + h[2, 0] * u + h[2, 1] * v
        over = 1 / z if z > 0 else 0.0
        x = (center_x + h[0, 0] * u + h[0, 1] * v) * over - 0.5
        y = (center_y + h[1, 0] * u + h[1, 1] * v) * over - 0.5
        # NaN compares false, and is also clamped into the photograph.
        x = min(x, width - 1.0) if x > 0 else 0.0
        y = min(y, height - 1.0) if y > 0 else 0.0
        column, row = min(int(x), width - 2), min(int(y), height - 2)
        right, down = np.float32(x - column), np.float32(y - row)
        upper = log[row, column] + right * (log[row, column + 1] - log[row, column])
        lower = log[row + 1, column]
        lower += right * (log[row + 1, column + 1] - lower)
        patch[s] = (upper + down * (lower - upper)) * root[s]
    for component in range(light.shape[1]):
        fraction = np.float32(0)
        for s in range(len(patch)):
            fraction += patch[s] * light[s, component]
        for s in range(len(patch)):
            patch[s] -= fraction * light[s, component]


@compiled(fast=True)
def _power(values: Array) -> float:
    """Return the sum of squares."""
    total: Any = np.float32(0)
    for s in range(len(values)):
        total += values[s] * values[s]
    return total


@compiled(fast=True)
def _worst_variance(inverse: Array) -> float:
    """Return the largest eigenvalue of a symmetric two by two matrix."""
    trace = (float(inverse[0, 0]) + inverse[1, 1]) / 2
    half_difference = (float(inverse[0, 0]) - inverse[1, 1]) / 2
    return trace + np.sqrt(half_difference**2 + float(inverse[0, 1]) ** 2)


@compiled(fast=True)
def _step(
    patch: Array, template: Array, slope: Array, inverse: Array, contrast: float
) -> tuple[Any, Any, Any]:
    """Return the Gauss-Newton step along the plane, and the sum of squared residuals."""
    gradient_x, gradient_y, squares = np.float32(0), np.float32(0), np.float32(0)
    for s in range(len(patch)):
        residual = patch[s] / contrast - template[s]
        gradient_x += slope[s, 0] * residual
        gradient_y += slope[s, 1] * residual
        squares += residual * residual
    step_x = -(inverse[0, 0] * gradient_x + inverse[0, 1] * gradient_y)
    step_y = -(inverse[1, 0] * gradient_x + inverse[1, 1] * gradient_y)
    return step_x, step_y, squares


@compiled(annotated=True, fast=True)
def align(
    log: Annotated[Array, "float32[:,:]"],
    homographies: signatures.Doubles3,
    chosen: signatures.Integers1,
    templates: PatchTemplates,
    window: PatchWindow,
    limits: signatures.Doubles1,
    result: Alignment,
) -> None:
    """Align one view's patches by Gauss-Newton steps with the templates' slopes.

    Args:
        homographies: From steps in the plane to pixels, one a point.
        chosen: Template of each.
        limits: Maximum iterations; maximum step; step of convergence; iterations before the
            correlation is tested; its minimum; bounds of the contrast; maximum shift.
    """
    patch = np.empty(len(window.root), np.float32)
    iterations, grace = int(limits[0]), int(limits[3])
    max_step, converged, min_correlation = limits[1], limits[2], limits[4]
    min_contrast, max_contrast, max_shift = limits[5], limits[6], limits[7]
    total = _power(window.root)
    for i in range(len(homographies)):
        t = chosen[i]
        template, slope, inverse = templates.values[t], templates.slopes[t], templates.inverse[t]
        power: Any = max(_power(template), np.float32(1e-12))
        worst = _worst_variance(inverse)
        along, across = 0.0, 0.0
        has_converged = False
        for iteration in range(iterations):
            _sample_patch(log, homographies[i], along, across, window, patch)
            common, norm = np.float32(0), np.float32(0)
            for s in range(len(patch)):
                common += patch[s] * template[s]
                norm += patch[s] * patch[s]
            contrast = min(max(common / power, np.float32(min_contrast)), np.float32(max_contrast))
            step_x, step_y, squares = _step(patch, template, slope, inverse, contrast)
            length = np.sqrt(float(step_x) ** 2 + float(step_y) ** 2)
            scale = max_step / max(length, max_step)
            along += step_x * scale
            across += step_y * scale
            result.deviation[i] = np.sqrt(squares / total * worst)
            size: Any = max(np.sqrt(norm) * np.sqrt(power), np.float32(1e-12))
            result.correlation[i] = common / size
            if np.sqrt(along**2 + across**2) > max_shift:
                break
            if iteration >= grace and result.correlation[i] < min_correlation:
                break
            if length <= converged:
                has_converged = True
                break
        result.shift[i, 0] = along if has_converged else np.inf
        result.shift[i, 1] = across if has_converged else np.inf
