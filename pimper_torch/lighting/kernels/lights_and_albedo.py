"""Joint fit of lights and albedo by damped Gauss-Newton, for ``lighting.light_fit``.

Arrays are view by sample, so that loops run along samples. The number of samples is a multiple of
TILE; no view sees those of the padding.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.dense_systems import solve_damped
from pimper_torch.kernels.robust_scale import robust_variance
from pimper_torch.kernels.twin_constants import CAUCHY_TUNING, MIN_DEVIATION

Doubles = NDArray[np.float64]

# Samples of a tile, with equations summed together: those of 24 views fit the cache.
TILE = 256

# The initial damping, its factors after accepted and rejected steps, and its bounds.
_DAMPING, _LESS, _MORE, _MIN_DAMPING, _MAX_DAMPING = 1e-3, 0.25, 10.0, 1e-9, 1e6


@compiled(fast=True)
def _shade(geometry: Doubles, lights: Doubles, shading: Doubles) -> None:
    """Compute radiance of albedo 1 under the harmonics and the point light, if there is one."""
    terms = _soft_terms(geometry, lights[0])
    for v in range(len(lights)):
        light, row = lights[v], shading[v]
        row[:] = 0
        for k in range(terms):
            harmonic = geometry[k]
            for i in range(len(row)):
                row[i] += light[k] * harmonic[i]
        if terms == len(light):
            continue
        a, b, c = geometry[terms], geometry[terms + 1], geometry[terms + 2]
        d, e, f = geometry[terms + 3], geometry[terms + 4], geometry[terms + 5]
        strength, x, y, z = _direction(light[terms:])
        near = light[terms + 3]
        for i in range(len(row)):
            p, q, r = x - near * d[i], y - near * e[i], z - near * f[i]
            distance = max(math.sqrt(p * p + q * q + r * r), 1e-6)
            facing = max(a[i] * p + b[i] * q + c[i] * r, 0.0)
            row[i] += strength * facing / (distance * distance * distance)


@compiled()
def _soft_terms(geometry: Doubles, light: Doubles) -> int:
    """Return the number of soft coefficients; a point light has 4 values and 6 coordinates."""
    return len(light) if len(geometry) == len(light) else len(light) - 4


@compiled()
def _direction(light: Doubles) -> tuple[float, float, float, float]:
    strength = math.sqrt(light[0] ** 2 + light[1] ** 2 + light[2] ** 2)
    scale = 1 / strength if strength > 0 else 1.0
    return strength, light[0] * scale, light[1] * scale, light[2] * scale


@compiled(fast=True)
def _slopes(geometry: Doubles, light: Doubles, first: int, slopes: Doubles) -> None:
    """Compute the derivatives of a view's shading by the parameters of its light, for a tile."""
    terms = _soft_terms(geometry, light)
    samples = slice(first, first + TILE)
    for j in range(terms):
        row = geometry[j, samples]
        for i in range(TILE):
            slopes[j * TILE + i] = row[i]
    if terms == len(light):
        return
    a, b, c = (
        geometry[terms, samples],
        geometry[terms + 1, samples],
        geometry[terms + 2, samples],
    )
    d, e, f = (
        geometry[terms + 3, samples],
        geometry[terms + 4, samples],
        geometry[terms + 5, samples],
    )
    strength, x, y, z = _direction(light[terms:])
    near, offset = light[terms + 3], terms * TILE
    for i in range(TILE):
        k, m, n = a[i], b[i], c[i]
        s, t, u = d[i], e[i], f[i]
        p, q, r = x - near * s, y - near * t, z - near * u
        distance = max(math.sqrt(p * p + q * q + r * r), 1e-6)
        facing = k * p + m * q + n * r
        lit = 1.0 if facing > 0 else 0.0
        inverse = 1 / distance
        falloff = lit * inverse * inverse * inverse
        radial = 3 * facing * inverse * inverse
        g, h, j = falloff * (k - radial * p), falloff * (m - radial * q), falloff * (n - radial * r)
        along = facing * falloff - (g * x + h * y + j * z)
        slopes[offset + i] = g + along * x
        slopes[offset + TILE + i] = h + along * y
        slopes[offset + 2 * TILE + i] = j + along * z
        slopes[offset + 3 * TILE + i] = -strength * (g * s + h * t + j * u)


@compiled()
def _clamp(geometry: Doubles, lights: Doubles, max_inverse_distance: float) -> None:
    """Clamp the parameters to their bounds: see ``light_models``."""
    for light in lights:
        light[0] = max(light[0], 0.0)
        if _soft_terms(geometry, light) < len(light):
            light[-1] = min(max(light[-1], 0.0), max_inverse_distance)


@compiled(fast=True)
def _residuals(
    radiance: Doubles, seen: Doubles, albedo: Doubles, shading: Doubles, residual: Doubles
) -> None:
    for v in range(len(radiance)):
        x, visible, shade, errors = radiance[v], seen[v], shading[v], residual[v]
        for i in range(len(albedo)):
            errors[i] = visible[i] * (x[i] - albedo[i] * shade[i])


@compiled(fast=True)
def _weigh(residual: Doubles, seen: Doubles, scale: Doubles, weight: Doubles) -> float:
    """Write Cauchy's weights, and return the sum of the loss."""
    total = 0.0
    for v in range(len(residual)):
        errors, visible, weights = residual[v], seen[v], weight[v]
        inverse = 1 / scale[v] if scale[v] > 0 else 0.0
        for i in range(len(errors)):
            relative = errors[i] * inverse
            weights[i] = visible[i] / (1 + relative * relative)
        # A logarithm of a product is cheaper than a sum of logarithms.
        product, logarithm = 1.0, 0.0
        for i in range(len(errors)):
            relative = errors[i] * inverse
            product *= 1 + relative * relative
            if product > 1e100:  # one more factor does not overflow
                logarithm += math.log(product)
                product = 1.0
        total += scale[v] * scale[v] * (logarithm + math.log(product))
    return total


@compiled(fast=True)
def _scales(
    residual: Doubles, seen: Doubles, mean: Doubles, widen: float, guess: Doubles, scale: Doubles
) -> None:
    squares = np.empty(residual.shape[1] + 1)
    for v in range(len(residual)):
        errors, visible, count = residual[v], seen[v], 0
        for i in range(len(errors)):
            squares[count] = errors[i] * errors[i]
            count += visible[i] > 0
        variance, guess[v] = robust_variance(squares[:count], guess[v], np.float32)
        scale[v] = widen * CAUCHY_TUNING * max(math.sqrt(variance), MIN_DEVIATION * mean[v])


@compiled(fast=True)
def _settle(
    radiance: Doubles,
    seen: Doubles,
    shading: Doubles,
    scale: Doubles,
    weight: Doubles,
    residual: Doubles,
    albedo: Doubles,
) -> float:
    """Solve for albedo with the present weights, and again with weights of its residuals.

    Returns:
        The loss of the final residuals; weights and residuals are updated.
    """
    square, product = np.empty_like(albedo), np.empty_like(albedo)
    cost = 0.0
    for _ in range(2):
        square[:] = 0
        product[:] = 0
        for v in range(len(radiance)):
            x, weights, shade = radiance[v], weight[v], shading[v]
            for i in range(len(albedo)):
                square[i] += weights[i] * shade[i] * shade[i]
            for i in range(len(albedo)):
                product[i] += weights[i] * shade[i] * x[i]
        for i in range(len(albedo)):
            if square[i] > 0:
                albedo[i] = product[i] / square[i]
        _residuals(radiance, seen, albedo, shading, residual)
        cost = _weigh(residual, seen, scale, weight)
    return cost


@compiled(fast=True)
def _tile(
    geometry: Doubles,
    lights: Doubles,
    shading: Doubles,
    residual: Doubles,
    weight: Doubles,
    albedo: Doubles,
    first: int,
    slopes: Doubles,
    cross: Doubles,
    diagonal: Doubles,
    albedo_gradient: Doubles,
    matrix: Doubles,
    gradient: Doubles,
) -> None:
    """Add a tile's part of the equations of the lights, and compute those of its albedos."""
    num_views, size = lights.shape
    samples = slice(first, first + TILE)
    square, by_albedo, albedo_tile = diagonal[samples], albedo_gradient[samples], albedo[samples]
    square[:] = 0
    by_albedo[:] = 0
    weighted_slope = np.empty(TILE)
    for v in range(num_views):
        _slopes(geometry, lights[v], first, slopes)
        weights, shade, errors = weight[v, samples], shading[v, samples], residual[v, samples]
        for i in range(TILE):
            square[i] += weights[i] * shade[i] * shade[i]
        for i in range(TILE):
            by_albedo[i] += weights[i] * errors[i] * shade[i]
        for p in range(size):
            for i in range(TILE):
                weighted_slope[i] = weights[i] * albedo_tile[i] * slopes[p * TILE + i]
            total = 0.0
            row = cross[v * size + p, samples]
            for i in range(TILE):
                row[i] = weighted_slope[i] * shade[i]
            for i in range(TILE):
                total += weighted_slope[i] * errors[i]
            gradient[v * size + p] += total
            for q in range(p, size):
                total = 0.0
                for i in range(TILE):
                    total += weighted_slope[i] * (albedo_tile[i] * slopes[q * TILE + i])
                matrix[v * size + p, v * size + q] += total


@compiled(fast=True)
def _eliminate(cross: Doubles, inverse: Doubles, first: int, matrix: Doubles) -> None:
    """Subtract a tile's part of the Schur complement from the equations, upper triangle."""
    weights = np.empty(TILE)
    samples = slice(first, first + TILE)
    inverse_tile = inverse[samples]
    count = len(cross)
    nonzero = np.empty(count, np.bool_)
    for p in range(count):
        row = cross[p, samples]
        total = 0.0
        for i in range(TILE):
            total += inverse_tile[i] * row[i] * row[i]
        nonzero[p] = total != 0
    for p in range(count):
        if not nonzero[p]:
            continue
        row = cross[p, samples]
        for i in range(TILE):
            weights[i] = inverse_tile[i] * row[i]
        q = p
        while q + 4 <= count:
            if not (nonzero[q] or nonzero[q + 1] or nonzero[q + 2] or nonzero[q + 3]):
                q += 4
                continue
            a, b = cross[q, samples], cross[q + 1, samples]
            c, d = cross[q + 2, samples], cross[q + 3, samples]
            on_a = on_b = on_c = on_d = 0.0
            for i in range(TILE):
                on_a += weights[i] * a[i]
                on_b += weights[i] * b[i]
                on_c += weights[i] * c[i]
                on_d += weights[i] * d[i]
            matrix[p, q] -= on_a
            matrix[p, q + 1] -= on_b
            matrix[p, q + 2] -= on_c
            matrix[p, q + 3] -= on_d
            q += 4
        while q < count:
            a = cross[q, samples]
            on_a = 0.0
            for i in range(TILE):
                on_a += weights[i] * a[i]
            matrix[p, q] -= on_a
            q += 1


@compiled(fast=True)
def _step(
    geometry: Doubles,
    lights: Doubles,
    shading: Doubles,
    residual: Doubles,
    weight: Doubles,
    albedo: Doubles,
    damping: float,
    max_inverse_distance: float,
    cross: Doubles,
    new_lights: Doubles,
    new_albedo: Doubles,
) -> bool:
    """Solve the damped Gauss-Newton equations, albedos eliminated; false if not definite."""
    num_views, size = lights.shape
    count, num_samples = num_views * size, len(albedo)
    padded = 4 * (-(-count // 4))
    matrix, gradient = np.zeros((padded, padded)), np.zeros(padded)
    diagonal, albedo_gradient = np.empty(num_samples), np.empty(num_samples)
    slopes = np.empty(size * TILE)
    for first in range(0, num_samples, TILE):
        _tile(
            geometry, lights, shading, residual, weight, albedo, first,
            slopes, cross, diagonal, albedo_gradient, matrix, gradient
        )  # fmt: skip
    for v in range(num_views):
        total = 0.0
        for p in range(size):
            total += matrix[v * size + p, v * size + p]
        for p in range(size):
            index = v * size + p
            matrix[index, index] += damping * matrix[index, index] + (
                1e-9 * total if total > 0 else 1.0
            )
    for i in range(num_samples):
        diagonal[i] = 1 / (diagonal[i] * (1 + damping)) if diagonal[i] > 0 else 0.0
    for first in range(0, num_samples, TILE):
        _eliminate(cross, diagonal, first, matrix)
    for v in range(num_views):
        for p in range(size):
            new_lights[v, p] = lights[v, p] + gradient[v * size + p]
    _clamp(geometry, new_lights, max_inverse_distance)
    rhs = np.zeros(padded)
    for index in range(count):
        v, p = index // size, index % size
        row = cross[index]
        total = 0.0
        for i in range(num_samples):
            total += row[i] * diagonal[i] * albedo_gradient[i]
        rhs[index] = gradient[index] - total
        if new_lights[v, p] == lights[v, p]:
            # Active bound: the gradient is directed out of the feasible set.
            matrix[index, :] = 0
            matrix[:, index] = 0
            matrix[index, index], rhs[index] = 1.0, 0.0
    for index in range(count, padded):
        matrix[index, index] = 1.0
    if not solve_damped(matrix, 0.0, rhs, np.empty_like(matrix)):
        return False
    for index in range(count):
        new_lights[index // size, index % size] = lights[index // size, index % size] + rhs[index]
        row, step = cross[index], rhs[index]
        for i in range(num_samples):
            albedo_gradient[i] -= step * row[i]
    for i in range(num_samples):
        new_albedo[i] = albedo[i] + diagonal[i] * albedo_gradient[i]
    _clamp(geometry, new_lights, max_inverse_distance)
    return True


@compiled(
    "void(float64[:,::1], float64[:,::1], float64[:,::1], float64[::1], float64, int64, float64,"
    " float64[:,::1], float64[::1])"
)
def fit(
    geometry: Doubles,
    radiance: Doubles,
    seen: Doubles,
    brightness: Doubles,
    max_inverse_distance: float,
    limit: int,
    min_gain: float,
    lights: Doubles,
    albedo: Doubles,
) -> None:
    """Minimize the loss over lights and albedo, in place.

    Args:
        geometry: Harmonics by sample; with a point light, also coordinates of normals and points.
        radiance: View by sample; zero where not seen.
        brightness: Mean radiance of each view.
        min_gain: The iteration ends after a step that reduces the loss by less than this fraction.
    """
    shading, residual = np.empty_like(radiance), np.empty_like(radiance)
    trial_shading, new_residual = np.empty_like(radiance), np.empty_like(radiance)
    weight = np.empty_like(radiance)
    cross = np.empty((lights.size, len(albedo)))
    new_lights, new_albedo = np.empty_like(lights), np.empty_like(albedo)
    scale, guess = np.zeros(len(lights)), np.zeros(len(lights))
    _clamp(geometry, lights, max_inverse_distance)
    _shade(geometry, lights, shading)
    _residuals(radiance, seen, albedo, shading, residual)
    damping = _DAMPING
    for step in range(limit):
        widen = max(1.0, 4.0 * 0.7**step)
        _scales(residual, seen, brightness, widen, guess, scale)
        cost = _weigh(residual, seen, scale, weight)
        after = np.inf
        if _step(
            geometry, lights, shading, residual, weight, albedo, damping, max_inverse_distance,
            cross, new_lights, new_albedo
        ):  # fmt: skip
            _shade(geometry, new_lights, trial_shading)
            after = _settle(radiance, seen, trial_shading, scale, weight, new_residual, new_albedo)
        if after < cost:
            for v in range(len(lights)):
                for p in range(lights.shape[1]):
                    lights[v, p] = new_lights[v, p]
            for i in range(len(albedo)):
                albedo[i] = new_albedo[i]
            shading, trial_shading = trial_shading, shading
            residual, new_residual = new_residual, residual
            damping = max(damping * _LESS, _MIN_DAMPING)
            if widen == 1 and after > cost * (1 - min_gain):
                break
        else:
            damping = min(damping * _MORE, _MAX_DAMPING)
