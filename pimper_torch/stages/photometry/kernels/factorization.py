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
from pimper_torch.kernels.twin_constants import (
    DAMPING_DECREASE,
    DAMPING_INCREASE,
    INITIAL_DAMPING,
    SHADING_STEPS,
    SQUARES,
    ZERO_ROUNDINGS,
)
from pimper_torch.stages.photometry.kernels import residuals, shading_steps
from pimper_torch.stages.photometry.kernels.packed_patches import (
    ConeProblem,
    ConeSolution,
    Patch,
    copy_unseen,
    gathered,
    packed,
    scattered,
    selected,
)
from pimper_torch.stages.photometry.kernels.shading_steps import COLUMNS, ROWS, TILE

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Integers = NDArray[np.int64]

_EPS = float(np.finfo(np.float32).eps)

# Codes of StopCause.
_CONVERGED, _STALLED, _LIMIT, _EMPTY = 0, 1, 2, 3


class Limits(NamedTuple):
    """See ``solve_variable_projection``; ``curvature_samples`` of 0 uses all samples."""

    max_iterations: int
    tolerance: float
    small_steps: int
    curvature_samples: int


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
            _, scale = residuals.update_weights(patch, lights, shading, scale, np.float32)
            if iteration == 0:
                energy, _ = residuals.weighted_square(patch.weight, patch.radiance)
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
            shading_steps.update_shading(patch.equations, new_shading, SHADING_STEPS)
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
def _equations(patch: Patch, lights: Floats) -> None:
    shading_steps.matrices_of_samples(patch.prior, lights, patch.weight, patch.equations)
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
    shading_steps.whitening(patch.equations, shading, whitener)
    stride = max(1, num_samples // samples) if samples > 0 else 1
    chosen = -(-num_samples // stride)
    white, pairs = (
        np.empty((3, num_views, chosen), np.float32),
        np.empty((10, chosen), np.float32),
    )
    for i in range(10):
        target, first, second = pairs[i], shading[ROWS[i]], shading[COLUMNS[i]]
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
        row, column = ROWS[index], COLUMNS[index]
        curvature[4 * f + row, 4 * g + column] = factor * sums[index]
        curvature[4 * f + column, 4 * g + row] = factor * sums[index]


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
    for p in range(len(problem.given)):
        copy_unseen(problem, p, problem.prior_mean, solution.lights)
        selection = selected(problem, p, stride)
        patch = packed(problem, selection, TILE, loss, scale)
        padded = patch.radiance.shape[1]
        light, shade = gathered(solution.lights, solution.shading, selection, padded)
        solution.iterations[p], solution.cause[p] = _solve(patch, light, shade, limits)
        residuals.compute(patch, light, shade)
        solution.residual[p], count = residuals.residual_size(patch)
        if not count > 0:
            solution.cause[p] = _EMPTY
        scattered(solution, selection, patch.weight, light, shade)
