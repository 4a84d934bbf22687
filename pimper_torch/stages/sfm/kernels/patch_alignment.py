"""Alignment of a view's patches with templates."""

import numpy as np
import numpy.typing as npt

from pimper_torch.kernels.compile import compiled

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@compiled(
    "void(float32[:,:], float64[:,:,::1], int64[::1], float32[:,::1], float32[:,:,::1],"
    " float32[:,:,::1], float32[:,::1], float32[::1], float32[:,::1], float64[::1],"
    " float64[:,::1], float64[::1], float64[::1])",
    fast=True,
)
def align(
    log: Floats,
    homographies: Doubles,
    chosen: Indices,
    values: Floats,
    slopes: Floats,
    inverse: Floats,
    offsets: Floats,
    root: Floats,
    light: Floats,
    limits: Doubles,
    shift: Doubles,
    deviation: Doubles,
    correlation: Doubles,
) -> None:
    """Align one view's patches by Gauss-Newton steps with the templates' slopes.

    Args:
        homographies: From steps in the plane to pixels, one a point.
        values: Of the templates, with changes of light projected out.
        offsets: Homogeneous steps in the plane, one column a sample.
        light: Basis of changes of light, orthonormal columns.
        limits: Maximum iterations; maximum step; step of convergence; iterations before the
            correlation is tested; its minimum; bounds of the contrast; maximum shift.
        shift: Result, along the plane; infinite if the patch was lost or did not converge.
        deviation: Result: standard deviation of the point along its worst direction, in steps.
        correlation: Result: with the template.
    """
    height, width = log.shape
    samples, num_components = light.shape
    patch = np.empty(samples, np.float32)
    iterations, grace = int(limits[0]), int(limits[3])
    max_step, converged, min_correlation = limits[1], limits[2], limits[4]
    min_contrast, max_contrast, max_shift = limits[5], limits[6], limits[7]
    total = np.float32(0)
    for s in range(samples):
        total += root[s] * root[s]
    for i in range(len(homographies)):
        t = chosen[i]
        h = homographies[i]
        template, slope = values[t], slopes[t]
        power = np.float32(0)
        for s in range(samples):
            power += template[s] * template[s]
        power = max(power, np.float32(1e-12))
        trace = (float(inverse[t, 0, 0]) + inverse[t, 1, 1]) / 2
        half_difference = (float(inverse[t, 0, 0]) - inverse[t, 1, 1]) / 2
        spread = trace + np.sqrt(half_difference**2 + float(inverse[t, 0, 1]) ** 2)
        along, across = 0.0, 0.0
        has_converged = False
        for iteration in range(iterations):
            center_x = h[0, 2] + h[0, 0] * along + h[0, 1] * across
            center_y = h[1, 2] + h[1, 0] * along + h[1, 1] * across
            center_z = h[2, 2] + h[2, 0] * along + h[2, 1] * across
            for s in range(samples):
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
            for component in range(num_components):
                fraction = np.float32(0)
                for s in range(samples):
                    fraction += patch[s] * light[s, component]
                for s in range(samples):
                    patch[s] -= fraction * light[s, component]
            common, norm = np.float32(0), np.float32(0)
            for s in range(samples):
                common += patch[s] * template[s]
                norm += patch[s] * patch[s]
            contrast = min(max(common / power, np.float32(min_contrast)), np.float32(max_contrast))
            gradient_x, gradient_y, squares = np.float32(0), np.float32(0), np.float32(0)
            for s in range(samples):
                residual = patch[s] / contrast - template[s]
                gradient_x += slope[s, 0] * residual
                gradient_y += slope[s, 1] * residual
                squares += residual * residual
            step_x = -(inverse[t, 0, 0] * gradient_x + inverse[t, 0, 1] * gradient_y)
            step_y = -(inverse[t, 1, 0] * gradient_x + inverse[t, 1, 1] * gradient_y)
            length = np.sqrt(float(step_x) ** 2 + float(step_y) ** 2)
            scale = max_step / max(length, max_step)
            along += step_x * scale
            across += step_y * scale
            deviation[i] = np.sqrt(squares / total * spread)
            correlation[i] = common / max(np.sqrt(norm) * np.sqrt(power), np.float32(1e-12))
            if np.sqrt(along**2 + across**2) > max_shift:
                break
            if iteration >= grace and correlation[i] < min_correlation:
                break
            if length <= converged:
                has_converged = True
                break
        shift[i, 0] = along if has_converged else np.inf
        shift[i, 1] = across if has_converged else np.inf
