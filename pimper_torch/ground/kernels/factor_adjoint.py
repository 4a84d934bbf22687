"""Derivatives of factorizations on the cone: twin of ``method.photometry.factor_gradients``.

A patch at a time is packed as by :mod:`~pimper_torch.ground.kernels.factorization`, in float64.
With ``G`` minus half the gradient of the objective, in which the scale of the robust weights
depends on the residuals, ``dG = -(H - q p^T) dx`` plus the derivative by the data. ``H`` is the
Hessian; ``q`` is the derivative of ``G`` by the residuals' deviation, and ``p`` that of the
deviation by the unknowns ``x``: lights, and coordinates of samples along their tangents.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pimper_torch.ground.kernels.compile import compiled
from pimper_torch.ground.kernels.dense_systems import eliminate
from pimper_torch.ground.kernels.factorization import overwrite, samples_that_count
from pimper_torch.ground.kernels.robust_scale import robust_variance
from pimper_torch.ground.kernels.shading_steps import frame, project
from pimper_torch.ground.kernels.signatures import Doubles1, Doubles2, Doubles3
from pimper_torch.ground.kernels.twin_constants import CAUCHY, GEMAN_MCCLURE, MIN_DEVIATION, SQUARES

Doubles = NDArray[np.float64]
Integers = NDArray[np.int64]

# Newton steps at most, the shortest fraction of one, and the step, over the unknowns, that ends
# them: choices; few patches need more than five.
_STEPS, _SHORTEST, _CLOSE = 30, 1e-3, 1e-11

# Added to the lights' Hessian, as a fraction of its mean diagonal: undetermined directions, as
# Lorentz transformations of free lights, do not move.
_RIDGE = 1e-10

# A patch whose adjoint is larger counts as singular: products would leave the range of float32.
_MOST = 1e25


class FactorSolution(NamedTuple):
    """Solutions of a batch, or derivatives by them: see ``Factors``."""

    lights: Doubles3
    shading: Doubles3
    weight: Doubles3
    residual: Doubles1


class FactorData(NamedTuple):
    """Data of a batch, or derivatives by them: see ``Bilinear``."""

    radiance: Doubles3
    weight: Doubles3
    prior_mean: Doubles3
    regularization: Doubles2
    prior: Doubles3


class Data(NamedTuple):
    """A packed patch; the first ``num_scale`` samples estimate the residuals' deviation."""

    radiance: Doubles
    given: Doubles
    prior_mean: Doubles
    regularization: Doubles
    prior: Doubles
    num_scale: int
    level: float
    loss: int
    scale: float


class Point(NamedTuple):
    """Derivatives at lights and shading, entries view by sample.

    Attributes:
        weight: Robust weight.
        slope: The weight's derivative by the relative square of the residual.
        weighted: Residual times all weights.
        bend: Second derivative of the loss.
        by_residual: Derivative of the deviation by each residual.
        along: Product of light and each tangent: ``3 views`` by sample.
        basis: Tangents: row ``4 a + i`` is component ``i`` of tangent ``a``.
        inverse: Of every sample's block of the Hessian, nine rows.
        mixed: Block of lights and samples: ``4 views`` by ``3 samples``.
        solved: The same times ``inverse``.
        schur: Schur complement, of the lights.
        numbers: The deviation, the root mean square and the sum of the given weights.
    """

    residual: Doubles
    weight: Doubles
    slope: Doubles
    weighted: Doubles
    bend: Doubles
    by_residual: Doubles
    along: Doubles
    basis: Doubles
    inverse: Doubles
    mixed: Doubles
    solved: Doubles
    schur: Doubles
    numbers: Doubles


@compiled()
def _views_with_data(given: Doubles) -> Integers:
    found = np.empty(len(given), np.int64)
    count = 0
    for f in range(len(given)):
        if np.any(given[f] > 0):
            found[count] = f
            count += 1
    return found[:count]


@compiled()
def _data(
    problem: FactorData,
    p: int,
    views: Integers,
    samples: Integers,
    num_scale: int,
    loss: int,
    scale: float,
) -> Data:
    shape = len(views), len(samples)
    radiance, given = np.empty(shape), np.empty(shape)
    prior_mean, regularization = np.empty((len(views), 4)), np.empty(len(views))
    prior = np.empty((10, len(samples)))
    size, count = 0.0, 0.0
    for f in range(len(views)):
        for k in range(len(samples)):
            radiance[f, k] = problem.radiance[p, views[f], samples[k]]
            given[f, k] = problem.weight[p, views[f], samples[k]]
            size += abs(radiance[f, k])
            count += given[f, k]
        for i in range(4):
            prior_mean[f, i] = problem.prior_mean[p, views[f], i]
        regularization[f] = problem.regularization[p, views[f]]
    for i in range(10):
        for k in range(len(samples)):
            prior[i, k] = problem.prior[p, i, samples[k]]
    level = MIN_DEVIATION * size / max(count, 1.0)
    return Data(radiance, given, prior_mean, regularization, prior, num_scale, level, loss, scale)


@compiled()
def _start(
    lights: Doubles3, shading: Doubles3, p: int, views: Integers, samples: Integers
) -> tuple[Doubles, Doubles]:
    light, shade = np.empty((len(views), 4)), np.empty((4, len(samples)))
    for i in range(4):
        for f in range(len(views)):
            light[f, i] = lights[p, views[f], i]
        for k in range(len(samples)):
            shade[i, k] = shading[p, i, samples[k]]
    return light, shade


@compiled()
def _point(views: int, samples: int) -> Point:
    shape = views, samples
    return Point(
        np.empty(shape),
        np.empty(shape),
        np.empty(shape),
        np.empty(shape),
        np.empty(shape),
        np.empty(shape),
        np.empty((3 * views, samples)),
        np.empty((12, samples)),
        np.empty((9, samples)),
        np.empty((4 * views, 3 * samples)),
        np.empty((4 * views, 3 * samples)),
        np.empty((4 * views, 4 * views)),
        np.zeros(3),
    )


@compiled(fast=True)
def _evaluate(data: Data, lights: Doubles, shading: Doubles, at: Point) -> None:
    """Compute residuals, weights and their derivatives, and the tangents."""
    _residuals(data, lights, shading, at.residual)
    total, count = 0.0, 0.0
    for f in range(len(lights)):
        for k in range(shading.shape[1]):
            total += data.given[f, k] * at.residual[f, k] ** 2
            count += data.given[f, k]
    at.numbers[1] = math.sqrt(total / count) if count > 0 else 0.0
    at.numbers[2] = count
    at.by_residual[:] = 0
    at.numbers[0] = _deviation(data, at) if data.loss != SQUARES else 0.0
    width = data.scale * at.numbers[0]
    inverse = 1 / width if width > 0 else 0.0
    for f in range(len(lights)):
        for k in range(shading.shape[1]):
            relative = at.residual[f, k] * inverse
            square = relative * relative
            weight, slope = 1.0, 0.0
            if data.loss == CAUCHY:
                weight = 1 / (1 + square)
                slope = -weight * weight
            elif data.loss == GEMAN_MCCLURE:
                root = 1 / (1 + square)
                weight = root * root
                slope = -2 * weight * root
            elif data.loss != SQUARES and square > 1:
                weight = 1 / abs(relative)
                slope = -0.5 * weight / square
            at.weight[f, k], at.slope[f, k] = weight, slope
            at.weighted[f, k] = data.given[f, k] * weight * at.residual[f, k]
            at.bend[f, k] = data.given[f, k] * (weight + 2 * square * slope)
    for k in range(shading.shape[1]):
        n, first, second = frame((shading[0, k], shading[1, k], shading[2, k], shading[3, k]))
        at.basis[0, k], at.basis[4, k], at.basis[8, k] = 1, 0, 0
        for i in range(3):
            at.basis[1 + i, k], at.basis[5 + i, k] = n[i], first[i]
            at.basis[9 + i, k] = second[i]


@compiled(fast=True)
def _residuals(data: Data, lights: Doubles, shading: Doubles, residual: Doubles) -> None:
    s, x, y, z = shading[0], shading[1], shading[2], shading[3]
    for f in range(len(lights)):
        a, b, c, d = lights[f, 0], lights[f, 1], lights[f, 2], lights[f, 3]
        for k in range(len(s)):
            predicted = a * s[k] + b * x[k] + c * y[k] + d * z[k]
            residual[f, k] = data.radiance[f, k] - predicted


@compiled(fast=True)
def _deviation(data: Data, at: Point) -> float:
    """Estimate the residuals' deviation, and its derivatives unless it is at its bound."""
    squares = np.empty(len(data.given) * data.num_scale)
    count = 0
    for f in range(len(data.given)):
        for k in range(data.num_scale):
            if data.given[f, k] > 0:
                squares[count] = at.residual[f, k] ** 2
                count += 1
    variance, scale = robust_variance(squares[:count], 0.0, np.float64)
    deviation = math.sqrt(variance)
    if not deviation > data.level:
        return data.level
    total = 0.0
    for f in range(len(data.given)):
        for k in range(data.num_scale):
            if data.given[f, k] > 0:
                r = at.residual[f, k]
                ratio = min(r * r / scale, 1e9)
                fraction = ratio * ratio / (1 + ratio * ratio)
                total += fraction * (1 - fraction)
                at.by_residual[f, k] = ratio * r / scale / (1 + ratio * ratio) ** 2
    for f in range(len(data.given)):
        for k in range(data.num_scale):
            at.by_residual[f, k] *= deviation / total if total > 0 else 0.0
    return deviation


@compiled(fast=True)
def _pull(
    field: Doubles,
    lights: Doubles,
    shading: Doubles,
    at: Point,
    on_lights: Doubles,
    on_samples: Doubles,
) -> None:
    """Sum entries times shading over samples, and times light and tangent over views."""
    for f in range(len(lights)):
        for i in range(4):
            total = 0.0
            for k in range(field.shape[1]):
                total += field[f, k] * shading[i, k]
            on_lights[f, i] = total
    ambient = np.zeros((4, field.shape[1]))
    for i in range(4):
        for f in range(len(lights)):
            light = lights[f, i]
            for k in range(field.shape[1]):
                ambient[i, k] += light * field[f, k]
    _coordinates(at, ambient, on_samples)


@compiled(fast=True)
def _coordinates(at: Point, ambient: Doubles, on_samples: Doubles) -> None:
    for a in range(3):
        for k in range(ambient.shape[1]):
            on_samples[a, k] = (
                at.basis[4 * a, k] * ambient[0, k]
                + at.basis[4 * a + 1, k] * ambient[1, k]
                + at.basis[4 * a + 2, k] * ambient[2, k]
                + at.basis[4 * a + 3, k] * ambient[3, k]
            )


@compiled(fast=True)
def _descent(
    data: Data,
    lights: Doubles,
    shading: Doubles,
    at: Point,
    on_lights: Doubles,
    on_samples: Doubles,
) -> float:
    """Compute minus half the gradient, and return its square."""
    _pull(at.weighted, lights, shading, at, on_lights, on_samples)
    image, drawn = np.empty_like(shading), np.empty((3, shading.shape[1]))
    _prior_image(data, shading, image)
    _coordinates(at, image, drawn)
    on_samples -= drawn
    for f in range(len(lights)):
        on_lights[f] -= data.regularization[f] * (lights[f] - data.prior_mean[f])
    return np.sum(on_lights**2) + np.sum(on_samples**2)


@compiled(fast=True)
def _prior_image(data: Data, vectors: Doubles, image: Doubles) -> None:
    """Multiply each sample's prior with its vector."""
    overwrite(image, np.zeros_like(image))
    entry = 0
    for i in range(4):
        for j in range(i, 4):
            prior = data.prior[entry]
            for k in range(vectors.shape[1]):
                image[i, k] += prior[k] * vectors[j, k]
                if i != j:
                    image[j, k] += prior[k] * vectors[i, k]
            entry += 1


@compiled(fast=True)
def _hessian(data: Data, lights: Doubles, shading: Doubles, at: Point) -> None:
    """Compute the Hessian's blocks, and the Schur complement of the samples."""
    num_views, num_samples = len(lights), shading.shape[1]
    for a in range(3):
        for f in range(num_views):
            for k in range(num_samples):
                at.along[a * num_views + f, k] = (
                    lights[f, 0] * at.basis[4 * a, k]
                    + lights[f, 1] * at.basis[4 * a + 1, k]
                    + lights[f, 2] * at.basis[4 * a + 2, k]
                    + lights[f, 3] * at.basis[4 * a + 3, k]
                )
    _inverses(data, lights, shading, at)
    for f in range(num_views):
        for i in range(4):
            for a in range(3):
                along, bend = at.along[a * num_views + f], at.bend[f]
                weighted, basis, component = at.weighted[f], at.basis[4 * a + i], shading[i]
                row = at.mixed[4 * f + i, a * num_samples : (a + 1) * num_samples]
                for k in range(num_samples):
                    row[k] = bend[k] * along[k] * component[k] - weighted[k] * basis[k]
            source = at.mixed[4 * f + i]
            for a in range(3):
                target = at.solved[4 * f + i, a * num_samples : (a + 1) * num_samples]
                u, v, w = at.inverse[3 * a], at.inverse[3 * a + 1], at.inverse[3 * a + 2]
                for k in range(num_samples):
                    target[k] = (
                        u[k] * source[k]
                        + v[k] * source[num_samples + k]
                        + w[k] * source[2 * num_samples + k]
                    )
    trace = 0.0
    for i in range(4 * num_views):
        for j in range(i, 4 * num_views):
            found = -_product(at.solved[i], at.mixed[j])
            at.schur[i, j] = found
            at.schur[j, i] = found
    for f in range(num_views):
        for i in range(4):
            for j in range(4):
                total, bend = 0.0, at.bend[f]
                for k in range(num_samples):
                    total += bend[k] * shading[i, k] * shading[j, k]
                at.schur[4 * f + i, 4 * f + j] += total
                if i == j:
                    at.schur[4 * f + i, 4 * f + i] += data.regularization[f]
                    trace += total + data.regularization[f]
    for i in range(4 * num_views):
        at.schur[i, i] += _RIDGE * max(trace / (4 * num_views), 1e-300)


@compiled(fast=True)
def _product(one: Doubles, other: Doubles) -> float:
    total = 0.0
    for k in range(len(one)):
        total += one[k] * other[k]
    return total


@compiled(fast=True)
def _inverses(data: Data, lights: Doubles, shading: Doubles, at: Point) -> None:
    """Invert every sample's block; zero where it has no data, which does not move."""
    num_views = len(lights)
    slope, images = np.empty_like(shading), np.empty_like(at.basis)
    _prior_image(data, shading, slope)
    for a in range(3):
        _prior_image(data, at.basis[4 * a : 4 * a + 4], images[4 * a : 4 * a + 4])
    for k in range(shading.shape[1]):
        g1, g2, g3 = slope[1, k], slope[2, k], slope[3, k]
        m00 = m01 = m02 = m11 = m12 = m22 = 0.0
        for f in range(num_views):
            bend, weighted = at.bend[f, k], at.weighted[f, k]
            u = at.along[f, k]
            v, w = at.along[num_views + f, k], at.along[2 * num_views + f, k]
            m00 += bend * u * u
            m01 += bend * u * v
            m02 += bend * u * w
            m11 += bend * v * v
            m12 += bend * v * w
            m22 += bend * w * w
            g1 -= lights[f, 1] * weighted
            g2 -= lights[f, 2] * weighted
            g3 -= lights[f, 3] * weighted
        p, q, r = images[0:4, k], images[4:8, k], images[8:12, k]
        n, first, second = at.basis[0:4, k], at.basis[4:8, k], at.basis[8:12, k]
        for i in range(4):
            m00 += n[i] * p[i]
            m01 += first[i] * p[i]
            m02 += second[i] * p[i]
            m11 += first[i] * q[i]
            m12 += second[i] * q[i]
            m22 += second[i] * r[i]
        albedo = shading[0, k]
        per = 1 / albedo if albedo > 0 else 1.0
        m01 += per * (g1 * first[1] + g2 * first[2] + g3 * first[3])
        m02 += per * (g1 * second[1] + g2 * second[2] + g3 * second[3])
        bowed = per * (g1 * n[1] + g2 * n[2] + g3 * n[3])
        m11 -= bowed
        m22 -= bowed
        c00, c01, c02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
        determinant = m00 * c00 + m01 * c01 + m02 * c02
        inverse = 1 / determinant if determinant != 0 else 0.0
        at.inverse[0, k] = inverse * c00
        at.inverse[1, k] = at.inverse[3, k] = inverse * c01
        at.inverse[2, k] = at.inverse[6, k] = inverse * c02
        at.inverse[4, k] = inverse * (m00 * m22 - m02 * m02)
        at.inverse[5, k] = at.inverse[7, k] = inverse * (m01 * m02 - m00 * m12)
        at.inverse[8, k] = inverse * (m00 * m11 - m01 * m01)


@compiled(fast=True)
def _solve(at: Point, on_lights: Doubles, on_samples: Doubles) -> bool:
    """Apply the Hessian's inverse to two right-hand sides, in place; False where it has none.

    Args:
        on_lights: Right-hand side, view, 4.
        on_samples: Right-hand side, tangent, sample.
    """
    num_views, num_samples = on_lights.shape[1], on_samples.shape[2]
    schur, rhs = at.schur.copy(), np.empty((4 * num_views, 2))
    inner = np.empty_like(on_samples)
    for side in range(2):
        for a in range(3):
            for k in range(num_samples):
                inner[side, a, k] = (
                    at.inverse[3 * a, k] * on_samples[side, 0, k]
                    + at.inverse[3 * a + 1, k] * on_samples[side, 1, k]
                    + at.inverse[3 * a + 2, k] * on_samples[side, 2, k]
                )
        for row in range(4 * num_views):
            total = 0.0
            for a in range(3):
                for k in range(num_samples):
                    total += at.mixed[row, a * num_samples + k] * inner[side, a, k]
            rhs[row, side] = on_lights[side, row // 4, row % 4] - total
    if not eliminate(schur, rhs):
        return False
    for side in range(2):
        for row in range(4 * num_views):
            step = rhs[row, side]
            on_lights[side, row // 4, row % 4] = step
            for a in range(3):
                for k in range(num_samples):
                    inner[side, a, k] -= at.solved[row, a * num_samples + k] * step
    overwrite(on_samples[0], inner[0])
    overwrite(on_samples[1], inner[1])
    return True


@compiled(fast=True)
def _by_deviation(at: Point, field: Doubles) -> None:
    """Compute the derivative of the weighted residuals by the deviation.

    A weight depends on the residual over the deviation alone, so that no derivative of it by the
    deviation is needed.
    """
    per = 1 / at.numbers[0] if at.numbers[0] > 0 else 0.0
    for f in range(len(field)):
        for k in range(field.shape[1]):
            field[f, k] = per * (at.weighted[f, k] - at.bend[f, k] * at.residual[f, k])


@compiled(fast=True)
def _ambient(at: Point, on_samples: Doubles, ambient: Doubles) -> None:
    """Combine tangents to shading vectors."""
    for i in range(4):
        for k in range(on_samples.shape[1]):
            ambient[i, k] = (
                at.basis[i, k] * on_samples[0, k]
                + at.basis[4 + i, k] * on_samples[1, k]
                + at.basis[8 + i, k] * on_samples[2, k]
            )


@compiled(fast=True)
def _corrected(
    at: Point,
    other_lights: Doubles,
    other_samples: Doubles,
    on_lights: Doubles,
    on_samples: Doubles,
) -> bool:
    """Solve with the Hessian and its rank-one term, by the Sherman-Morrison formula.

    Args:
        other_lights: The factor of the term that is not the second right-hand side, here and in
            ``other_samples``.
        on_lights: The first right-hand side becomes the solution, here and in ``on_samples``.
    """
    if not _solve(at, on_lights, on_samples):
        return False
    along = np.sum(other_lights * on_lights[0]) + np.sum(other_samples * on_samples[0])
    remainder = 1 + np.sum(other_lights * on_lights[1]) + np.sum(other_samples * on_samples[1])
    factor = along / remainder if remainder != 0 else 0.0
    on_lights[0] -= factor * on_lights[1]
    on_samples[0] -= factor * on_samples[1]
    return True


@compiled(fast=True)
def _newton_refined(data: Data, lights: Doubles, shading: Doubles, weight: Doubles) -> float:
    """Take Newton steps as long as they reduce the gradient; return the root mean square."""
    num_views, num_samples = data.radiance.shape
    at = _point(num_views, num_samples)
    on_lights, on_samples = np.empty((2, num_views, 4)), np.empty((2, 3, num_samples))
    p_lights, p_samples = np.empty((num_views, 4)), np.empty((3, num_samples))
    field, change = np.empty((num_views, num_samples)), np.zeros((4, num_samples))
    new_lights, new_shading, way = lights.copy(), shading.copy(), np.zeros((num_views, 4))
    size, fraction, rms = np.inf, 0.5, 0.0
    for _ in range(_STEPS):
        _evaluate(data, new_lights, new_shading, at)
        new_size = _descent(data, new_lights, new_shading, at, on_lights[0], on_samples[0])
        if new_size < size:
            moved, square = np.sum((new_lights - lights) ** 2), np.sum(lights**2)
            overwrite(lights, new_lights)
            overwrite(shading, new_shading)
            overwrite(weight, data.given * at.weight)
            first, rms = size == np.inf, at.numbers[1]
            size, fraction = new_size, min(2 * fraction, 1.0)
            if moved <= _CLOSE * _CLOSE * square and not first:
                return rms
            _hessian(data, lights, shading, at)
            _by_deviation(at, field)
            _pull(field, lights, shading, at, on_lights[1], on_samples[1])
            _pull(at.by_residual, lights, shading, at, p_lights, p_samples)
            if not _corrected(at, p_lights, p_samples, on_lights, on_samples):
                return rms
            overwrite(way, on_lights[0])
            _ambient(at, on_samples[0], change)
        else:
            fraction /= 2
            if fraction < _SHORTEST:
                return rms
        new_lights, trial = lights + fraction * way, shading + fraction * change
        for k in range(num_samples):
            found = project(trial[0, k], trial[1, k], trial[2, k], trial[3, k])
            for i in range(4):
                new_shading[i, k] = found[i]
    return rms


@compiled(fast=True)
def _pull_back(
    data: Data,
    light: Doubles,
    shade: Doubles,
    p: int,
    views: Integers,
    samples: Integers,
    given: FactorSolution,
    found: FactorData,
) -> None:
    num_views, num_samples = len(views), len(samples)
    at = _point(num_views, num_samples)
    _evaluate(data, light, shade, at)
    _hessian(data, light, shade, at)
    deviation, rms, count = at.numbers[0], at.numbers[1], at.numbers[2]
    width = data.scale * deviation
    per_width = 1 / width if width > 0 else 0.0
    per_rms = given.residual[p] / (count * rms) if rms > 0 else 0.0
    # Of weights and residuals themselves, lights and shading fixed.
    direct, total = np.empty((num_views, num_samples)), 0.0
    for f in range(num_views):
        for k in range(num_samples):
            relative = at.residual[f, k] * per_width
            on_weight = data.given[f, k] * given.weight[p, views[f], samples[k]]
            on_relative = 2 * on_weight * at.slope[f, k] * relative
            direct[f, k] = on_relative * per_width
            direct[f, k] += per_rms * data.given[f, k] * at.residual[f, k]
            total -= on_relative * relative
    direct += (total / deviation if deviation > 0 else 0.0) * at.by_residual
    on_lights, on_samples = np.empty((2, num_views, 4)), np.empty((2, 3, num_samples))
    _pull(direct, light, shade, at, on_lights[0], on_samples[0])
    ambient, drawn = np.empty((4, num_samples)), np.empty((3, num_samples))
    for i in range(4):
        for f in range(num_views):
            on_lights[0, f, i] = given.lights[p, views[f], i] - on_lights[0, f, i]
        for k in range(num_samples):
            ambient[i, k] = given.shading[p, i, samples[k]]
    _coordinates(at, ambient, drawn)
    overwrite(on_samples[0], drawn - on_samples[0])
    q_lights, q_samples = np.empty((num_views, 4)), np.empty((3, num_samples))
    field = np.empty((num_views, num_samples))
    _by_deviation(at, field)
    _pull(field, light, shade, at, q_lights, q_samples)
    _pull(at.by_residual, light, shade, at, on_lights[1], on_samples[1])
    if not _corrected(at, q_lights, q_samples, on_lights, on_samples):
        return
    if not np.sum(np.abs(on_lights[0])) + np.sum(np.abs(on_samples[0])) < _MOST:
        return
    on_deviation = np.sum(q_lights * on_lights[0]) + np.sum(q_samples * on_samples[0])
    _ambient(at, on_samples[0], ambient)
    for f in range(num_views):
        for k in range(num_samples):
            moved = (
                on_lights[0, f, 0] * shade[0, k]
                + on_lights[0, f, 1] * shade[1, k]
                + on_lights[0, f, 2] * shade[2, k]
                + on_lights[0, f, 3] * shade[3, k]
                + light[f, 0] * ambient[0, k]
                + light[f, 1] * ambient[1, k]
                + light[f, 2] * ambient[2, k]
                + light[f, 3] * ambient[3, k]
            )
            r, weight = at.residual[f, k], at.weight[f, k]
            found.radiance[p, views[f], samples[k]] = (
                at.bend[f, k] * moved + on_deviation * at.by_residual[f, k] + direct[f, k]
            )
            found.weight[p, views[f], samples[k]] = weight * (
                r * moved + given.weight[p, views[f], samples[k]]
            ) + 0.5 * per_rms * (r * r - rms * rms)
        for i in range(4):
            found.prior_mean[p, views[f], i] = data.regularization[f] * on_lights[0, f, i]
        found.regularization[p, views[f]] = np.sum(
            on_lights[0, f] * (data.prior_mean[f] - light[f])
        )
    entry = 0
    for i in range(4):
        for j in range(i, 4):
            for k in range(num_samples):
                product = ambient[i, k] * shade[j, k]
                if i != j:
                    product += ambient[j, k] * shade[i, k]
                found.prior[p, entry, samples[k]] = -product
            entry += 1


@compiled()
def _is_anchored(problem: FactorData, p: int, f: int) -> bool:
    """Return whether the light of a view is its anchor: without data."""
    return problem.regularization[p, f] > 0 and not np.any(problem.weight[p, f] > 0)


@compiled(annotated=True)
def refine(
    problem: FactorData, loss: int, scale: float, stride: int, solution: FactorSolution
) -> None:
    """Take a batch of solutions to rest by Newton's method, and compute weights and residuals.

    Args:
        loss: Its code.
        scale: Of the loss, in standard deviations.
        stride: The deviation is estimated from every ``stride``-th sample.
        solution: Lights and shading where it starts; weights and residuals are zero before.
    """
    lights, shading, weight, residual = solution
    for p in range(len(lights)):
        for f in range(lights.shape[1]):
            if _is_anchored(problem, p, f):
                for i in range(4):
                    lights[p, f, i] = problem.prior_mean[p, f, i]
        views = _views_with_data(problem.weight[p])
        samples, num_scale = samples_that_count(problem.weight[p], stride)
        if len(views) == 0:
            continue
        data = _data(problem, p, views, samples, num_scale, loss, scale)
        light, shade = _start(lights, shading, p, views, samples)
        heavy = np.empty(data.given.shape)
        residual[p] = _newton_refined(data, light, shade, heavy)
        for f in range(len(views)):
            for k in range(len(samples)):
                weight[p, views[f], samples[k]] = heavy[f, k]
        for i in range(4):
            for f in range(len(views)):
                lights[p, views[f], i] = light[f, i]
            for k in range(len(samples)):
                shading[p, i, samples[k]] = shade[i, k]


@compiled(annotated=True)
def pull_back(
    problem: FactorData,
    loss: int,
    scale: float,
    stride: int,
    lights: Doubles3,
    shading: Doubles3,
    given: FactorSolution,
    found: FactorData,
) -> None:
    """Compute derivatives by the data from those by the solution: the adjoint, at rest.

    Args:
        lights: The solution, as :func:`refine` leaves it, and ``shading``.
        found: Zero before, and after for a patch whose Hessian is singular, as without albedo.
    """
    for p in range(len(lights)):
        for f in range(lights.shape[1]):
            if _is_anchored(problem, p, f):
                for i in range(4):
                    found.prior_mean[p, f, i] = given.lights[p, f, i]
        views = _views_with_data(problem.weight[p])
        samples, num_scale = samples_that_count(problem.weight[p], stride)
        if len(views) == 0:
            continue
        data = _data(problem, p, views, samples, num_scale, loss, scale)
        light, shade = _start(lights, shading, p, views, samples)
        _pull_back(data, light, shade, p, views, samples, given, found)
