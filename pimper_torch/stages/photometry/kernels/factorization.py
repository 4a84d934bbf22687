"""Damped variable projection on the cone, patch by patch.

Twin of ``stages.photometry.variable_projection.solve_variable_projection`` for first-order light. A
patch is packed without samples and views that have no data, so it stays in the cache during the
iterations. Radiance, weights and shading are float32; sums over samples are vectorized, those over
views are float64.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.dense_systems import solve_damped
from pimper_torch.kernels.robust_scale import robust_variance
from pimper_torch.kernels.signatures import Floats1, Floats2, Floats3, Integers1
from pimper_torch.kernels.twin_constants import (
    CAUCHY,
    DAMPING_DECREASE,
    DAMPING_INCREASE,
    GEMAN_MCCLURE,
    INITIAL_DAMPING,
    MIN_DEVIATION,
    SHADING_STEPS,
    SQUARES,
    ZERO_ROUNDINGS,
)
from pimper_torch.stages.photometry.kernels.shading_steps import TILE, update_shading, whitening

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Integers = NDArray[np.int64]

_EPS = float(np.finfo(np.float32).eps)

# Codes of StopCause.
_CONVERGED, _STALLED, _LIMIT, _EMPTY = 0, 1, 2, 3

# Row and column of each entry of a packed matrix.
_ROWS = (0, 0, 0, 0, 1, 1, 1, 2, 2, 3)
_COLUMNS = (0, 1, 2, 3, 1, 2, 3, 2, 3, 3)


class ConeProblem(NamedTuple):
    """A batch of problems: see ``stages.photometry.bilinear``; ``given`` are the weights."""

    radiance: Floats3
    given: Floats3
    prior_mean: Floats3
    regularization: Floats2
    prior: Floats3


class Limits(NamedTuple):
    """See ``solve_variable_projection``; ``curvature_samples`` of 0 uses all samples."""

    max_iterations: int
    tolerance: float
    small_steps: int
    curvature_samples: int


class ConeSolution(NamedTuple):
    """The solution of a batch.

    Attributes:
        shading: Samples without weight keep their initial value.
        weight: Final weights; zero before.
        residual: Root mean square.
        cause: Code of the stop cause.
    """

    lights: Floats3
    shading: Floats3
    weight: Floats3
    iterations: Integers1
    residual: Floats1
    cause: Integers1


class Patch(NamedTuple):
    """A packed patch: views and samples with data, padded to whole tiles.

    Attributes:
        radiance: View by sample.
        given: Weight of each entry; 0 in the padding.
        weight: ``given`` times robust weights.
        residual: Workspace.
        prior: Packed entry by sample.
        equations: The samples' normal equations: ten packed entries and the right-hand side.
        prior_mean: View by 4.
        regularization: Of each view.
        slack: Sum of the regularization of the omitted views, times 4.
        num_views: Including omitted views.
        num_scale: Number of samples, the first ones, for the estimate of the residual deviation.
        min_deviation: Minimum deviation of residuals.
        loss: Code of the loss.
        scale: Of the loss, in deviations.
    """

    radiance: Floats
    given: Floats
    weight: Floats
    residual: Floats
    prior: Floats
    equations: Floats
    prior_mean: Floats
    regularization: Floats
    slack: float
    num_views: int
    num_scale: int
    min_deviation: float
    loss: int
    scale: float


@compiled()
def _views_that_count(
    given: Floats, prior_mean: Floats, regularization: Floats, lights: Floats
) -> Integers:
    """Return the views with data or with a light that is not its prior mean."""
    indices = np.empty(len(given), np.int64)
    count = 0
    for f in range(len(given)):
        fixed = regularization[f] > 0
        for i in range(4):
            fixed = fixed and lights[f, i] == prior_mean[f, i]
        if not fixed or np.any(given[f] > 0):
            indices[count] = f
            count += 1
    return indices[:count]


@compiled()
def samples_that_count(given: Floats, stride: int) -> tuple[Integers, int]:
    """Return the samples with data, first those for the deviation, and the number of the latter."""
    seen = np.zeros(given.shape[1], np.bool_)
    for f in range(len(given)):
        row = given[f]
        for k in range(len(row)):
            seen[k] |= row[k] > 0
    indices = np.empty(given.shape[1], np.int64)
    count = 0
    for k in range(0, len(seen), stride):
        if seen[k]:
            indices[count] = k
            count += 1
    num_scale = count
    for k in range(len(seen)):
        if seen[k] and k % stride > 0:
            indices[count] = k
            count += 1
    return indices[:count], num_scale


@compiled()
def _packed(
    problem: ConeProblem,
    p: int,
    views: Integers,
    selection: tuple[Integers, int],
    loss: int,
    scale: float,
) -> Patch:
    samples, num_scale = selection
    radiance, given, prior_mean = problem.radiance[p], problem.given[p], problem.prior_mean[p]
    regularization, prior = problem.regularization[p], problem.prior[p]
    num_views, num_samples = len(views), len(samples)
    padded = TILE * (-(-num_samples // TILE))
    shape = (num_views, padded)
    radiance_rows, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    view_prior_mean, view_regularization = (
        np.empty((num_views, 4), np.float32),
        np.empty(num_views, np.float32),
    )
    size, count, slack = 0.0, 0.0, 0.0
    for f in range(len(regularization)):
        slack += 4 * regularization[f]
    for f in range(num_views):
        source, weights_row = radiance[views[f]], given[views[f]]
        for k in range(num_samples):
            radiance_rows[f, k], weight[f, k] = source[samples[k]], weights_row[samples[k]]
            size += abs(radiance_rows[f, k])
            count += weight[f, k]
        for i in range(4):
            view_prior_mean[f, i] = prior_mean[views[f], i]
        view_regularization[f] = regularization[views[f]]
        slack -= 4 * view_regularization[f]
    prior_rows = np.zeros((10, padded), np.float32)
    for i in range(10):
        for k in range(num_samples):
            prior_rows[i, k] = prior[i, samples[k]]
    # The identity makes the equations of the padding regular.
    for i in (0, 4, 7, 9):
        prior_rows[i, num_samples:] = 1
    return Patch(
        radiance=radiance_rows,
        given=weight,
        weight=weight.copy(),
        residual=np.empty(shape, np.float32),
        prior=prior_rows,
        equations=np.empty((14, padded), np.float32),
        prior_mean=view_prior_mean,
        regularization=view_regularization,
        slack=max(slack, 0.0),
        num_views=len(regularization),
        num_scale=num_scale,
        min_deviation=MIN_DEVIATION * size / max(count, 1.0),
        loss=loss,
        scale=scale,
    )


@compiled()
def _solve(patch: Patch, lights: Floats, shading: Floats, limits: Limits) -> tuple[int, int]:
    """Factorize one patch; lights and shading are replaced by the solution.

    Returns:
        The number of steps, and the code of the stop cause.
    """
    max_iterations, tolerance, small_steps, curvature_samples = limits
    size = lights.size
    slope, step = np.zeros((len(lights), 4)), np.zeros(size)
    new_slope, new_lights, new_shading = np.zeros_like(slope), lights.copy(), shading.copy()
    curvature, factor, mean = np.zeros((size, size)), np.empty((size, size)), 0.0
    cost, energy, scale, damping, small = np.inf, 0.0, 0.0, INITIAL_DAMPING, 0
    better, exact, stalled = True, False, False
    # Iteration 0 evaluates the start, and every iteration evaluates the previous step. So most
    # functions inlined here are called only once: compiling a copy takes seconds.
    for iteration in range(max_iterations + 2):
        if better and iteration != 1:
            scale = _robust_weights(patch, lights, shading, scale)
            if iteration == 0:
                energy = _energy(patch)
            elif patch.loss != SQUARES:
                cost = _evaluate(patch, lights, shading, slope)
        if exact or small >= small_steps:
            return iteration - 1, _CONVERGED
        if stalled:
            return iteration - 1, _STALLED
        if iteration > max_iterations:
            break
        if iteration > 0:
            if better:
                _equations(patch, lights)
                _curvature(patch, lights, shading, curvature_samples, curvature)
            trace = 0.0
            for f in range(len(lights)):
                for i in range(4):
                    step[4 * f + i] = slope[f, i]
                    trace += curvature[4 * f + i, 4 * f + i]
            mean = (trace + patch.slack) / (4 * patch.num_views)
        after = np.inf
        if iteration == 0 or solve_damped(curvature, damping * max(mean, 1e-300), step, factor):
            if iteration > 0:
                for f in range(len(lights)):
                    for i in range(4):
                        new_lights[f, i] = lights[f, i] + step[4 * f + i]
                overwrite(new_shading, shading)
                _keep_scale(patch, lights, new_lights, new_shading)
            _equations(patch, new_lights)
            update_shading(patch.equations, new_shading, SHADING_STEPS)
            after = _evaluate(patch, new_lights, new_shading, new_slope)
        better = iteration == 0 or after < cost
        if iteration > 0:
            exact = cost <= (ZERO_ROUNDINGS * _EPS) ** 2 * energy
            if better:
                small = small + 1 if (cost - after) / max(cost, 1e-38) < tolerance else 0
            damping *= DAMPING_DECREASE if better else DAMPING_INCREASE
            stalled = damping > 1 / _EPS and not exact
            damping = max(damping, _EPS)
        if better:
            overwrite(lights, new_lights)
            overwrite(shading, new_shading)
            slope, new_slope, cost = new_slope, slope, after
    return max_iterations, _LIMIT


@compiled()
def overwrite(target: NDArray[Any], source: NDArray[Any]) -> None:
    """Copy a matrix; assigning slices would compile messages about shapes, a second each."""
    for i in range(len(target)):
        for k in range(target.shape[1]):
            target[i, k] = source[i, k]


@compiled(fast=True)
def _robust_weights(patch: Patch, lights: Floats, shading: Floats, start_scale: float) -> float:
    """Update the robust weights; return the initial scale for the next call."""
    if patch.loss == SQUARES:
        return 0.0
    squares = np.empty(patch.radiance.shape[0] * patch.num_scale, np.float32)
    count = 0
    for f in range(len(lights)):
        _residual(patch, lights[f], shading, f)
        residual_row, given = patch.residual[f], patch.given[f]
        for k in range(patch.num_scale):
            squares[count] = residual_row[k] * residual_row[k]
            count += given[k] > 0
    variance, scale = robust_variance(squares[:count], start_scale, np.float32)
    width = patch.scale * max(math.sqrt(variance), patch.min_deviation)
    one, inverse = np.float32(1), np.float32(1 / width if width > 0 else 0.0)
    for f in range(len(lights)):
        residual_row, given, weight = patch.residual[f], patch.given[f], patch.weight[f]
        if patch.loss == CAUCHY:
            for k in range(len(residual_row)):
                relative = residual_row[k] * inverse
                weight[k] = given[k] / (one + relative * relative)
        elif patch.loss == GEMAN_MCCLURE:
            for k in range(len(residual_row)):
                relative = residual_row[k] * inverse
                root = one / (one + relative * relative)
                weight[k] = given[k] * root * root
        else:
            for k in range(len(residual_row)):
                weight[k] = given[k] / max(one, abs(residual_row[k] * inverse))
    return scale


@compiled(fast=True)
def _residual(patch: Patch, light: Floats, shading: Floats, f: int) -> None:
    radiance, residual_row = patch.radiance[f], patch.residual[f]
    s, x, y, z = shading[0], shading[1], shading[2], shading[3]
    for k in range(len(residual_row)):
        residual_row[k] = radiance[k] - (
            light[0] * s[k] + light[1] * x[k] + light[2] * y[k] + light[3] * z[k]
        )


@compiled(fast=True)
def _energy(patch: Patch) -> float:
    total = 0.0
    for f in range(len(patch.radiance)):
        radiance, weight = patch.radiance[f], patch.weight[f]
        view_total = np.float32(0)
        for k in range(len(radiance)):
            view_total += weight[k] * radiance[k] * radiance[k]
        total += float(view_total)
    return total


@compiled(fast=True)
def _equations(patch: Patch, lights: Floats) -> None:
    for i in range(10):
        total, prior_rows = patch.equations[i], patch.prior[i]
        row, column = _ROWS[i], _COLUMNS[i]
        for k in range(len(total)):
            total[k] = prior_rows[k]
        for f in range(len(lights)):
            weight, factor = patch.weight[f], lights[f, row] * lights[f, column]
            for k in range(len(total)):
                total[k] += factor * weight[k]
    for i in range(4):
        total = patch.equations[10 + i]
        total[:] = 0
        for f in range(len(lights)):
            weight, radiance, factor = patch.weight[f], patch.radiance[f], lights[f, i]
            for k in range(len(total)):
                total[k] += factor * (weight[k] * radiance[k])


@compiled(fast=True)
def _evaluate(patch: Patch, lights: Floats, shading: Floats, slope: Doubles) -> float:
    """Return the objective, and write minus half its gradient by the lights to ``slope``."""
    s, x, y, z = shading[0], shading[1], shading[2], shading[3]
    zero = np.float32(0)
    total = 0.0
    for f in range(len(lights)):
        radiance, weight, light = patch.radiance[f], patch.weight[f], lights[f]
        cost, on_s, on_x, on_y, on_z = zero, zero, zero, zero, zero
        for k in range(len(s)):
            residual = radiance[k] - (
                light[0] * s[k] + light[1] * x[k] + light[2] * y[k] + light[3] * z[k]
            )
            weighted = weight[k] * residual
            cost += weighted * residual
            on_s += weighted * s[k]
            on_x += weighted * x[k]
            on_y += weighted * y[k]
            on_z += weighted * z[k]
        total += float(cost)
        slope[f, 0], slope[f, 1], slope[f, 2], slope[f, 3] = on_s, on_x, on_y, on_z
        for i in range(4):
            difference = float(light[i]) - float(patch.prior_mean[f, i])
            total += patch.regularization[f] * difference * difference
            slope[f, i] -= patch.regularization[f] * difference
    return total + _quadratic_penalty(patch.prior, s, x, y, z)


@compiled(fast=True)
def _quadratic_penalty(p: Floats, s: Floats, x: Floats, y: Floats, z: Floats) -> float:
    a, b, c, d, e, f, g, h, i, j = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9]
    total = np.float32(0)
    two = np.float32(2)
    for k in range(len(s)):
        total += s[k] * (a[k] * s[k] + two * (b[k] * x[k] + c[k] * y[k] + d[k] * z[k]))
        total += x[k] * (e[k] * x[k] + two * (f[k] * y[k] + g[k] * z[k]))
        total += y[k] * (h[k] * y[k] + two * i[k] * z[k]) + j[k] * z[k] * z[k]
    return float(total)


@compiled()
def _keep_scale(patch: Patch, before: Floats, lights: Floats, shading: Floats) -> None:
    """Normalize lights without regularization to their previous norm; rescale shading inversely."""
    before_size, size = 0.0, 0.0
    for f in range(len(lights)):
        if patch.regularization[f] > 0:
            return
        for i in range(4):
            before_size += before[f, i] ** 2
            size += lights[f, i] ** 2
    if patch.slack > 0 or not (before_size > 0 and size > 0):
        return
    factor = np.float32(math.sqrt(before_size / size))
    lights *= factor
    shading /= factor


@compiled(fast=True)
def _curvature(
    patch: Patch, lights: Floats, shading: Floats, samples: int, matrix: Doubles
) -> None:
    """Compute the upper triangle of the Gauss-Newton matrix from the current equations."""
    num_views, num_samples = patch.radiance.shape
    whitener = np.empty((12, num_samples), np.float32)
    whitening(patch.equations, shading, whitener)
    stride = max(1, num_samples // samples) if samples > 0 else 1
    chosen = -(-num_samples // stride)
    white, pairs = (
        np.empty((3, num_views, chosen), np.float32),
        np.empty((10, chosen), np.float32),
    )
    for i in range(10):
        target, first, second = pairs[i], shading[_ROWS[i]], shading[_COLUMNS[i]]
        for k in range(chosen):
            target[k] = first[k * stride] * second[k * stride]
    for j in range(3):
        a, b, c, d = whitener[4 * j], whitener[4 * j + 1], whitener[4 * j + 2], whitener[4 * j + 3]
        for f in range(num_views):
            target, weight, light = white[j, f], patch.weight[f], lights[f]
            for k in range(chosen):
                sample = k * stride
                target[k] = weight[sample] * (
                    light[0] * a[sample]
                    + light[1] * b[sample]
                    + light[2] * c[sample]
                    + light[3] * d[sample]
                )
    weights_row = np.zeros(chosen, np.float32)
    for f in range(num_views):
        for k in range(chosen):
            weights_row[k] = patch.weight[f, k * stride]
        for g in range(f, num_views):
            _block(white, f, g, weights_row, pairs, float(stride), matrix)
            weights_row[:] = 0
        for i in range(4):
            matrix[4 * f + i, 4 * f + i] += patch.regularization[f]


@compiled(fast=True)
def _block(
    white: Floats,
    f: int,
    g: int,
    weights_row: Floats,
    pairs: Floats,
    factor: float,
    curvature: Doubles,
) -> None:
    """Compute the block of two views: ``n n^T`` times the Schur complement, summed over samples."""
    u, v, w = white[0, f], white[1, f], white[2, f]
    x, y, z = white[0, g], white[1, g], white[2, g]
    a, b, c, d, e = pairs[0], pairs[1], pairs[2], pairs[3], pairs[4]
    i, j, h, m, n = pairs[5], pairs[6], pairs[7], pairs[8], pairs[9]
    zero = np.float32(0)
    sa = sb = sc = sd = se = si = sj = sh = sm = sn = zero
    for k in range(len(weights_row)):
        fraction = weights_row[k] - (u[k] * x[k] + v[k] * y[k] + w[k] * z[k])
        sa += fraction * a[k]
        sb += fraction * b[k]
        sc += fraction * c[k]
        sd += fraction * d[k]
        se += fraction * e[k]
        si += fraction * i[k]
        sj += fraction * j[k]
        sh += fraction * h[k]
        sm += fraction * m[k]
        sn += fraction * n[k]
    sums = (sa, sb, sc, sd, se, si, sj, sh, sm, sn)
    for index in range(10):
        row, column = _ROWS[index], _COLUMNS[index]
        curvature[4 * f + row, 4 * g + column] = factor * sums[index]
        curvature[4 * f + column, 4 * g + row] = factor * sums[index]


@compiled(fast=True)
def _root_mean_square(patch: Patch, lights: Floats, shading: Floats) -> tuple[float, bool]:
    total, count = 0.0, 0.0
    for f in range(len(lights)):
        _residual(patch, lights[f], shading, f)
        residual_row, given = patch.residual[f], patch.given[f]
        for k in range(len(residual_row)):
            total += given[k] * residual_row[k] * residual_row[k]
            count += given[k]
    return (math.sqrt(total / count) if count > 0 else 0.0), count > 0


@compiled(annotated=True)
def solve_on_cone(
    problem: ConeProblem,
    loss: int,
    scale: float,
    stride: int,
    limits: Limits,
    solution: ConeSolution,
) -> None:
    """Factorize a batch of patches, one after the other.

    Args:
        loss: Code of the loss.
        scale: Of the loss, in standard deviations.
        stride: The deviation is estimated from every ``stride``-th sample.
        solution: Result; lights and shading are the start.
    """
    _, given, prior_mean, regularization, _ = problem
    lights, shading, weight, iterations, residual, cause = solution
    for p in range(len(given)):
        views = _views_that_count(given[p], prior_mean[p], regularization[p], lights[p])
        samples, num_scale = samples_that_count(given[p], stride)
        patch = _packed(problem, p, views, (samples, num_scale), loss, scale)
        light = np.empty((len(views), 4), np.float32)
        shade = np.zeros((4, patch.radiance.shape[1]), np.float32)
        for f in range(len(views)):
            for i in range(4):
                light[f, i] = lights[p, views[f], i]
        for k in range(len(samples)):
            for i in range(4):
                shade[i, k] = shading[p, i, samples[k]]
        iterations[p], cause[p] = _solve(patch, light, shade, limits)
        residual[p], has_data = _root_mean_square(patch, light, shade)
        if not has_data:
            cause[p] = _EMPTY
        for f in range(len(views)):
            for i in range(4):
                lights[p, views[f], i] = light[f, i]
            for k in range(len(samples)):
                weight[p, views[f], samples[k]] = patch.weight[f, k]
        for i in range(4):
            for k in range(len(samples)):
                shading[p, i, samples[k]] = shade[i, k]
