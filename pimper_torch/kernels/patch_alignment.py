"""Patches of a view aligned with templates, one after the other.

The compiled twin of the iterations in :func:`pimper_torch.sfm.track observations._iterated`.
"""

import numpy as np
import numpy.typing as npt

from pimper_torch.kernels.switch import compiled

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
    places: Floats,
    root: Floats,
    light: Floats,
    limits: Doubles,
    shift: Doubles,
    deviation: Doubles,
    correlation: Doubles,
) -> None:
    """Align one view's patches by Gauss-Newton on the templates' slopes.

    Args:
        log: Of the view's radiance.
        homographies: From steps of the plane to pixels, one a point.
        chosen: The template of each point.
        values: Of the templates, light taken out.
        slopes: By a step along the plane.
        inverse: Of the slopes' normal equations.
        places: Steps of the plane, homogeneous, one column a sample.
        root: Of the window's weights.
        light: What light may change, orthonormal columns.
        limits: Iterations; the longest step; the one that ends; iterations after which a patch
            must have some correlation; which; bounds of the contrast; the longest shift.
        shift: Along the plane goes there; infinite where the patch was lost or did not arrive.
        deviation: Of the place along its worst direction, in steps.
        correlation: With the template.
    """
    height, width = log.shape
    samples, ways = light.shape
    patch = np.empty(samples, np.float32)
    iterations, trial = int(limits[0]), int(limits[3])
    longest, converged, hopeless = limits[1], limits[2], limits[4]
    least, most, farthest = limits[5], limits[6], limits[7]
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
        apart = (float(inverse[t, 0, 0]) - inverse[t, 1, 1]) / 2
        spread = trace + np.sqrt(apart**2 + float(inverse[t, 0, 1]) ** 2)
        along, across = 0.0, 0.0
        arrived = False
        for iteration in range(iterations):
            at_x = h[0, 2] + h[0, 0] * along + h[0, 1] * across
            at_y = h[1, 2] + h[1, 0] * along + h[1, 1] * across
            at_z = h[2, 2] + h[2, 0] * along + h[2, 1] * across
            for s in range(samples):
                u, v = places[0, s], places[1, s]
                z = at_z + h[2, 0] * u + h[2, 1] * v
                over = 1 / z if z > 0 else 0.0
                x = (at_x + h[0, 0] * u + h[0, 1] * v) * over - 0.5
                y = (at_y + h[1, 0] * u + h[1, 1] * v) * over - 0.5
                # Written so that what is no number is inside the photograph, too.
                x = min(x, width - 1.0) if x > 0 else 0.0
                y = min(y, height - 1.0) if y > 0 else 0.0
                column, row = min(int(x), width - 2), min(int(y), height - 2)
                right, down = np.float32(x - column), np.float32(y - row)
                upper = log[row, column] + right * (log[row, column + 1] - log[row, column])
                lower = log[row + 1, column]
                lower += right * (log[row + 1, column + 1] - lower)
                patch[s] = (upper + down * (lower - upper)) * root[s]
            for way in range(ways):
                fraction = np.float32(0)
                for s in range(samples):
                    fraction += patch[s] * light[s, way]
                for s in range(samples):
                    patch[s] -= fraction * light[s, way]
            common, norm = np.float32(0), np.float32(0)
            for s in range(samples):
                common += patch[s] * template[s]
                norm += patch[s] * patch[s]
            contrast = min(max(common / power, np.float32(least)), np.float32(most))
            regularization_x, regularization_y, left = np.float32(0), np.float32(0), np.float32(0)
            for s in range(samples):
                residual = patch[s] / contrast - template[s]
                regularization_x += slope[s, 0] * residual
                regularization_y += slope[s, 1] * residual
                left += residual * residual
            step_x = -(inverse[t, 0, 0] * regularization_x + inverse[t, 0, 1] * regularization_y)
            step_y = -(inverse[t, 1, 0] * regularization_x + inverse[t, 1, 1] * regularization_y)
            length = np.sqrt(float(step_x) ** 2 + float(step_y) ** 2)
            scale = longest / max(length, longest)
            along += step_x * scale
            across += step_y * scale
            deviation[i] = np.sqrt(left / total * spread)
            correlation[i] = common / max(np.sqrt(norm) * np.sqrt(power), np.float32(1e-12))
            if np.sqrt(along**2 + across**2) > farthest:
                break
            if iteration >= trial and correlation[i] < hopeless:
                break
            if length <= converged:
                arrived = True
                break
        shift[i, 0] = along if arrived else np.inf
        shift[i, 1] = across if arrived else np.inf
