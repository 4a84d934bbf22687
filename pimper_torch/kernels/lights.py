"""Lights and albedo fitted together: twin of ``photometry.light_fit``'s descent.

Everything is view by sample, so that loops run along samples; a multiple of TILE of them, the last
ones seen by no view.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.cholesky import solve_damped
from pimper_torch.kernels.spread import robust_variance
from pimper_torch.kernels.switch import compiled

Doubles = NDArray[np.float64]

# Samples whose equations are summed at once: those of 24 views then fit the cache.
TILE = 256

# As in the reference: Cauchy's scale in deviations, its least in brightnesses; and the damping.
_TUNING, _MIN_SCALE = 2.385, 1e-4
_DAMPING, _LESS, _MORE, _MIN_DAMPING, _MAX_DAMPING = 1e-3, 0.25, 10.0, 1e-9, 1e6
_FLOOR, _LARGE = 1e-9, 1e100


@compiled(fast=True)
def _shade(known: Doubles, lights: Doubles, shading: Doubles) -> None:
    """Give the radiance of albedo 1: soft light has four numbers a view, a point light five."""
    for v in range(len(lights)):
        light, row = lights[v], shading[v]
        a, b, c, d = known[0], known[1], known[2], known[3]
        if len(light) == 4:
            for i in range(len(row)):
                row[i] = light[0] * a[i] + light[1] * b[i] + light[2] * c[i] + light[3] * d[i]
            continue
        e, f = known[4], known[5]
        strength, x, y, z = _direction(light)
        for i in range(len(row)):
            p, q, r = x - light[4] * d[i], y - light[4] * e[i], z - light[4] * f[i]
            distance = max(math.sqrt(p * p + q * q + r * r), 1e-6)
            facing = max(a[i] * p + b[i] * q + c[i] * r, 0.0)
            row[i] = light[0] + strength * facing / (distance * distance * distance)


@compiled()
def _direction(light: Doubles) -> tuple[float, float, float, float]:
    strength = math.sqrt(light[1] ** 2 + light[2] ** 2 + light[3] ** 2)
    scale = 1 / strength if strength > 0 else 1.0
    return strength, light[1] * scale, light[2] * scale, light[3] * scale


@compiled(fast=True)
def _slopes(known: Doubles, light: Doubles, first: int, slopes: Doubles) -> None:
    """Give the derivatives of a view's shading by its numbers, for a tile's samples."""
    if len(light) == 4:
        for j in range(4):
            row = known[j, first : first + TILE]
            for i in range(TILE):
                slopes[j * TILE + i] = row[i]
        return
    some = slice(first, first + TILE)
    a, b, c = known[0, some], known[1, some], known[2, some]
    d, e, f = known[3, some], known[4, some], known[5, some]
    strength, x, y, z = _direction(light)
    for i in range(TILE):
        k, m, n = a[i], b[i], c[i]
        s, t, u = d[i], e[i], f[i]
        p, q, r = x - light[4] * s, y - light[4] * t, z - light[4] * u
        distance = max(math.sqrt(p * p + q * q + r * r), 1e-6)
        facing = k * p + m * q + n * r
        lit = 1.0 if facing > 0 else 0.0
        inverse = 1 / distance
        fall = lit * inverse * inverse * inverse
        more = 3 * facing * inverse * inverse
        g, h, j = fall * (k - more * p), fall * (m - more * q), fall * (n - more * r)
        along = facing * fall - (g * x + h * y + j * z)
        slopes[i] = 1.0
        slopes[TILE + i] = g + along * x
        slopes[2 * TILE + i] = h + along * y
        slopes[3 * TILE + i] = j + along * z
        slopes[4 * TILE + i] = -strength * (g * s + h * t + j * u)


@compiled()
def _admit(lights: Doubles, closest: float) -> None:
    """Bring the lights back to what makes sense: see the reference's models."""
    for light in lights:
        light[0] = max(light[0], 0.0)
        if len(light) == 5:
            light[4] = min(max(light[4], 0.0), closest)


@compiled(fast=True)
def _leave(
    radiance: Doubles, seen: Doubles, albedo: Doubles, shading: Doubles, residual: Doubles
) -> None:
    for v in range(len(radiance)):
        x, there, shade, left = radiance[v], seen[v], shading[v], residual[v]
        for i in range(len(albedo)):
            left[i] = there[i] * (x[i] - albedo[i] * shade[i])


@compiled(fast=True)
def _weigh(residual: Doubles, seen: Doubles, scale: Doubles, weight: Doubles) -> float:
    """Weigh by Cauchy's function, and give the sum of its loss."""
    total = 0.0
    for v in range(len(residual)):
        left, there, heavy = residual[v], seen[v], weight[v]
        inverse = 1 / scale[v] if scale[v] > 0 else 0.0
        for i in range(len(left)):
            relative = left[i] * inverse
            heavy[i] = there[i] / (1 + relative * relative)
        # One logarithm of many factors.
        product, logarithm = 1.0, 0.0
        for i in range(len(left)):
            relative = left[i] * inverse
            product *= 1 + relative * relative
            if product > _LARGE:
                logarithm += math.log(product)
                product = 1.0
        total += scale[v] * scale[v] * (logarithm + math.log(product))
    return total


@compiled(fast=True)
def _scales(
    residual: Doubles, seen: Doubles, level: Doubles, widen: float, guess: Doubles, scale: Doubles
) -> None:
    squares = np.empty(residual.shape[1] + 1)
    for v in range(len(residual)):
        left, there, count = residual[v], seen[v], 0
        for i in range(len(left)):
            squares[count] = left[i] * left[i]
            count += there[i] > 0
        variance, guess[v] = robust_variance(squares[:count], guess[v])
        scale[v] = widen * _TUNING * max(math.sqrt(variance), _MIN_SCALE * level[v])


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
    """Give the albedo that suits shading best, by the weights there are, then by its own.

    Returns:
        The loss of the residuals that are left; weights and residuals go with it.
    """
    square, product = np.empty_like(albedo), np.empty_like(albedo)
    cost = 0.0
    for _ in range(2):
        square[:] = 0
        product[:] = 0
        for v in range(len(radiance)):
            x, heavy, shade = radiance[v], weight[v], shading[v]
            for i in range(len(albedo)):
                square[i] += heavy[i] * shade[i] * shade[i]
            for i in range(len(albedo)):
                product[i] += heavy[i] * shade[i] * x[i]
        for i in range(len(albedo)):
            if square[i] > 0:
                albedo[i] = product[i] / square[i]
        _leave(radiance, seen, albedo, shading, residual)
        cost = _weigh(residual, seen, scale, weight)
    return cost


@compiled(fast=True)
def _tile(
    known: Doubles,
    lights: Doubles,
    shading: Doubles,
    residual: Doubles,
    weight: Doubles,
    albedo: Doubles,
    first: int,
    slopes: Doubles,
    cross: Doubles,
    own: Doubles,
    regularization: Doubles,
    matrix: Doubles,
    downhill: Doubles,
) -> None:
    """Add a tile's part of the lights' own equations, and set up its albedos'."""
    num_views, size = lights.shape
    some = slice(first, first + TILE)
    square, push, rho = own[some], regularization[some], albedo[some]
    square[:] = 0
    push[:] = 0
    by = np.empty(TILE)
    for v in range(num_views):
        _slopes(known, lights[v], first, slopes)
        heavy, shade, left = weight[v, some], shading[v, some], residual[v, some]
        for i in range(TILE):
            square[i] += heavy[i] * shade[i] * shade[i]
        for i in range(TILE):
            push[i] += heavy[i] * left[i] * shade[i]
        for p in range(size):
            for i in range(TILE):
                by[i] = heavy[i] * rho[i] * slopes[p * TILE + i]
            total = 0.0
            row = cross[v * size + p, some]
            for i in range(TILE):
                row[i] = by[i] * shade[i]
            for i in range(TILE):
                total += by[i] * left[i]
            downhill[v * size + p] += total
            for q in range(p, size):
                total = 0.0
                for i in range(TILE):
                    total += by[i] * (rho[i] * slopes[q * TILE + i])
                matrix[v * size + p, v * size + q] += total


@compiled(fast=True)
def _eliminate(cross: Doubles, inverse: Doubles, first: int, matrix: Doubles) -> None:
    """Take what a tile's albedos explain from the lights' equations, upper triangle."""
    heavy = np.empty(TILE)
    some = slice(first, first + TILE)
    own = inverse[some]
    for p in range(len(cross)):
        row = cross[p, some]
        shows = 0.0
        for i in range(TILE):
            heavy[i] = own[i] * row[i]
            shows += heavy[i] * heavy[i]
        if shows == 0:
            continue
        q = p
        while q + 4 <= len(cross):
            a, b = cross[q, some], cross[q + 1, some]
            c, d = cross[q + 2, some], cross[q + 3, some]
            on_a = on_b = on_c = on_d = 0.0
            for i in range(TILE):
                on_a += heavy[i] * a[i]
                on_b += heavy[i] * b[i]
                on_c += heavy[i] * c[i]
                on_d += heavy[i] * d[i]
            matrix[p, q] -= on_a
            matrix[p, q + 1] -= on_b
            matrix[p, q + 2] -= on_c
            matrix[p, q + 3] -= on_d
            q += 4
        while q < len(cross):
            a = cross[q, some]
            on_a = 0.0
            for i in range(TILE):
                on_a += heavy[i] * a[i]
            matrix[p, q] -= on_a
            q += 1


@compiled(fast=True)
def _step(
    known: Doubles,
    lights: Doubles,
    shading: Doubles,
    residual: Doubles,
    weight: Doubles,
    albedo: Doubles,
    damping: float,
    closest: float,
    cross: Doubles,
    moved: Doubles,
    changed: Doubles,
) -> bool:
    """Solve Gauss-Newton's damped equations, albedos eliminated; tell whether they allow it."""
    num_views, size = lights.shape
    count, num_samples = num_views * size, len(albedo)
    padded = 4 * (-(-count // 4))
    matrix, downhill = np.zeros((padded, padded)), np.zeros(padded)
    own, regularization = np.empty(num_samples), np.empty(num_samples)
    slopes = np.empty(size * TILE)
    for first in range(0, num_samples, TILE):
        _tile(
            known, lights, shading, residual, weight, albedo, first,
            slopes, cross, own, regularization, matrix, downhill,
        )  # fmt: skip
    for v in range(num_views):
        total = 0.0
        for p in range(size):
            total += matrix[v * size + p, v * size + p]
        for p in range(size):
            at = v * size + p
            matrix[at, at] += damping * matrix[at, at] + (_FLOOR * total if total > 0 else 1.0)
    for i in range(num_samples):
        own[i] = 1 / (own[i] * (1 + damping)) if own[i] > 0 else 0.0
    for first in range(0, num_samples, TILE):
        _eliminate(cross, own, first, matrix)
    for v in range(num_views):
        for p in range(size):
            moved[v, p] = lights[v, p] + downhill[v * size + p]
    _admit(moved, closest)
    side = np.zeros(padded)
    for at in range(count):
        v, p = at // size, at % size
        row = cross[at]
        total = 0.0
        for i in range(num_samples):
            total += row[i] * own[i] * regularization[i]
        side[at] = downhill[at] - total
        if moved[v, p] == lights[v, p]:
            # A parameter that would only be pushed over its bound stays out of the others' way.
            matrix[at, :] = 0
            matrix[:, at] = 0
            matrix[at, at], side[at] = 1.0, 0.0
    for at in range(count, padded):
        matrix[at, at] = 1.0
    if not solve_damped(matrix, 0.0, side, np.empty_like(matrix)):
        return False
    for at in range(count):
        moved[at // size, at % size] = lights[at // size, at % size] + side[at]
        row, by = cross[at], side[at]
        for i in range(num_samples):
            regularization[i] -= by * row[i]
    for i in range(num_samples):
        changed[i] = albedo[i] + own[i] * regularization[i]
    _admit(moved, closest)
    return True


@compiled(
    "void(float64[:,::1], float64[:,::1], float64[:,::1], float64[::1], float64, int64, float64,"
    " float64[:,::1], float64[::1])"
)
def fit(
    known: Doubles,
    radiance: Doubles,
    seen: Doubles,
    level: Doubles,
    closest: float,
    limit: int,
    min_gain: float,
    lights: Doubles,
    albedo: Doubles,
) -> None:
    """Step on lights and albedo together; both hold the start, and then the answer.

    Args:
        known: Rows of the samples: of soft light the four harmonics; of a point light the normal's
            coordinates and the place's.
        radiance: View by sample; zero where not seen.
        seen: 1 or 0.
        level: Brightness of each view.
        closest: A point light's closeness at most.
        limit: Steps at most.
        min_gain: Fraction of the loss that the last step gains at most.
        lights: View by number.
        albedo: Of each sample.
    """
    shading, residual = np.empty_like(radiance), np.empty_like(radiance)
    under, left, weight = np.empty_like(radiance), np.empty_like(radiance), np.empty_like(radiance)
    cross = np.empty((lights.size, len(albedo)))
    moved, changed = np.empty_like(lights), np.empty_like(albedo)
    scale, guess = np.zeros(len(lights)), np.zeros(len(lights))
    _admit(lights, closest)
    _shade(known, lights, shading)
    _leave(radiance, seen, albedo, shading, residual)
    damping = _DAMPING
    for step in range(limit):
        widen = max(1.0, 4.0 * 0.7**step)
        _scales(residual, seen, level, widen, guess, scale)
        cost = _weigh(residual, seen, scale, weight)
        after = np.inf
        if _step(
            known, lights, shading, residual, weight, albedo, damping, closest,
            cross, moved, changed,
        ):  # fmt: skip
            _shade(known, moved, under)
            after = _settle(radiance, seen, under, scale, weight, left, changed)
        if after < cost:
            lights[:], albedo[:] = moved, changed
            shading[:], residual[:] = under, left
            damping = max(damping * _LESS, _MIN_DAMPING)
            if widen == 1 and after > cost * (1 - min_gain):
                break
        else:
            damping = min(damping * _MORE, _MAX_DAMPING)
