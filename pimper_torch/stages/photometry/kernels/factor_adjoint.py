"""Derivatives of factorizations on the cone: twin of ``stages.photometry.factor_gradients``.

One patch at a time is packed as by
:mod:`~pimper_torch.stages.photometry.kernels.factorization`, in float64. Let ``G`` be minus half
the gradient of the objective, with a scale of the robust weights that depends on the residuals.
Then ``dG = -(H - q p^T) dx`` plus the derivative by the data. ``H`` is the Hessian, ``q`` the
derivative of ``G`` by the residuals' deviation, and ``p`` that of the deviation by the unknowns
``x``: lights, and coordinates of samples along their tangents.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.dense_systems import eliminate
from pimper_torch.kernels.robust_scale import robust_variance
from pimper_torch.kernels.signatures import Doubles1, Doubles2, Doubles3
from pimper_torch.kernels.twin_constants import CAUCHY, GEMAN_MCCLURE, MIN_DEVIATION, SQUARES
from pimper_torch.stages.photometry.kernels.factorization import overwrite, samples_that_count
from pimper_torch.stages.photometry.kernels.shading_steps import frame, project_to_cone

Doubles = NDArray[np.float64]
Integers = NDArray[np.int64]

# Maximum number of Newton steps, minimum fraction of a step, and the step relative to the unknowns
# that ends them: choices; few patches need more than five.
_STEPS, _SHORTEST, _CLOSE = 30, 1e-3, 1e-11

# Added to the lights' Hessian, as a fraction of its mean diagonal: undetermined directions, such as
# Lorentz transformations of free lights, do not change.
_RIDGE = 1e-10

# A patch with a larger adjoint counts as singular: products would exceed the range of float32.
_MAX_ADJOINT = 1e25


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
    min_deviation: float
    loss: int
    scale: float


class Point(NamedTuple):
    """Derivatives at a point of lights and shading; entries are view by sample.

    Attributes:
        weight: Robust weight.
        slope: Derivative of the weight by the squared relative residual.
        weighted: Residual times all weights.
        bend: Second derivative of the loss.
        by_residual: Derivative of the deviation by each residual.
        along: Product of light and each tangent: ``3 views`` by sample.
        basis: Tangents: row ``4 a + i`` is component ``i`` of tangent ``a``.
        inverse: Inverse of every sample's block of the Hessian, nine rows.
        mixed: Block of lights and samples: ``4 views`` by ``3 samples``.
        solved: ``mixed`` times ``inverse``.
        schur: Schur complement of the lights.
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
    indices = np.empty(len(given), np.int64)
    count = 0
    for f in range(len(given)):
        if np.any(given[f] > 0):
            indices[count] = f
            count += 1
    return indices[:count]


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
    least = MIN_DEVIATION * size / max(count, 1.0)
    return Data(radiance, given, prior_mean, regularization, prior, num_scale, least, loss, scale)


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
def _evaluate(data: Data, lights: Doubles, shading: Doubles, point: Point) -> None:
    """Compute residuals, weights and their derivatives, and the tangents."""
    _residuals(data, lights, shading, point.residual)
    total, count = 0.0, 0.0
    for f in range(len(lights)):
        for k in range(shading.shape[1]):
            total += data.given[f, k] * point.residual[f, k] ** 2
            count += data.given[f, k]
    point.numbers[1] = math.sqrt(total / count) if count > 0 else 0.0
    point.numbers[2] = count
    point.by_residual[:] = 0
    point.numbers[0] = _deviation(data, point) if data.loss != SQUARES else 0.0
    width = data.scale * point.numbers[0]
    inverse = 1 / width if width > 0 else 0.0
    for f in range(len(lights)):
        for k in range(shading.shape[1]):
            relative = point.residual[f, k] * inverse
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
            point.weight[f, k], point.slope[f, k] = weight, slope
            point.weighted[f, k] = data.given[f, k] * weight * point.residual[f, k]
            point.bend[f, k] = data.given[f, k] * (weight + 2 * square * slope)
    for k in range(shading.shape[1]):
        n, first, second = frame((shading[0, k], shading[1, k], shading[2, k], shading[3, k]))
        point.basis[0, k], point.basis[4, k], point.basis[8, k] = 1, 0, 0
        for i in range(3):
            point.basis[1 + i, k], point.basis[5 + i, k] = n[i], first[i]
            point.basis[9 + i, k] = second[i]


@compiled(fast=True)
def _residuals(data: Data, lights: Doubles, shading: Doubles, residual: Doubles) -> None:
    s, x, y, z = shading[0], shading[1], shading[2], shading[3]
    for f in range(len(lights)):
        a, b, c, d = lights[f, 0], lights[f, 1], lights[f, 2], lights[f, 3]
        for k in range(len(s)):
            predicted = a * s[k] + b * x[k] + c * y[k] + d * z[k]
            residual[f, k] = data.radiance[f, k] - predicted


@compiled(fast=True)
def _deviation(data: Data, point: Point) -> float:
    """Return the residuals' deviation, and write its derivatives unless it is at its bound."""
    squares = np.empty(len(data.given) * data.num_scale)
    count = 0
    for f in range(len(data.given)):
        for k in range(data.num_scale):
            if data.given[f, k] > 0:
                squares[count] = point.residual[f, k] ** 2
                count += 1
    variance, scale = robust_variance(squares[:count], 0.0, np.float64)
    deviation = math.sqrt(variance)
    if not deviation > data.min_deviation:
        return data.min_deviation
    total = 0.0
    for f in range(len(data.given)):
        for k in range(data.num_scale):
            if data.given[f, k] > 0:
                r = point.residual[f, k]
                ratio = min(r * r / scale, 1e9)
                fraction = ratio * ratio / (1 + ratio * ratio)
                total += fraction * (1 - fraction)
                point.by_residual[f, k] = ratio * r / scale / (1 + ratio * ratio) ** 2
    for f in range(len(data.given)):
        for k in range(data.num_scale):
            point.by_residual[f, k] *= deviation / total if total > 0 else 0.0
    return deviation


@compiled(fast=True)
def _pull(
    field: Doubles,
    lights: Doubles,
    shading: Doubles,
    point: Point,
    on_lights: Doubles,
    on_samples: Doubles,
) -> None:
    """Sum a field times shading over samples, and times light and tangents over views."""
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
    _coordinates(point, ambient, on_samples)


@compiled(fast=True)
def _coordinates(point: Point, ambient: Doubles, on_samples: Doubles) -> None:
    for a in range(3):
        for k in range(ambient.shape[1]):
            on_samples[a, k] = (
                point.basis[4 * a, k] * ambient[0, k]
                + point.basis[4 * a + 1, k] * ambient[1, k]
                + point.basis[4 * a + 2, k] * ambient[2, k]
                + point.basis[4 * a + 3, k] * ambient[3, k]
            )


@compiled(fast=True)
def _descent(
    data: Data,
    lights: Doubles,
    shading: Doubles,
    point: Point,
    on_lights: Doubles,
    on_samples: Doubles,
) -> float:
    """Write minus half the gradient, and return its squared norm."""
    _pull(point.weighted, lights, shading, point, on_lights, on_samples)
    image, coordinates = np.empty_like(shading), np.empty((3, shading.shape[1]))
    _prior_image(data, shading, image)
    _coordinates(point, image, coordinates)
    on_samples -= coordinates
    for f in range(len(lights)):
        on_lights[f] -= data.regularization[f] * (lights[f] - data.prior_mean[f])
    return np.sum(on_lights**2) + np.sum(on_samples**2)


@compiled(fast=True)
def _prior_image(data: Data, vectors: Doubles, image: Doubles) -> None:
    """Write the product of each sample's prior with its vector to ``image``."""
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
def _hessian(data: Data, lights: Doubles, shading: Doubles, point: Point) -> None:
    """Compute the Hessian's blocks, and the Schur complement of the samples."""
    num_views, num_samples = len(lights), shading.shape[1]
    for a in range(3):
        for f in range(num_views):
            for k in range(num_samples):
                point.along[a * num_views + f, k] = (
                    lights[f, 0] * point.basis[4 * a, k]
                    + lights[f, 1] * point.basis[4 * a + 1, k]
                    + lights[f, 2] * point.basis[4 * a + 2, k]
                    + lights[f, 3] * point.basis[4 * a + 3, k]
                )
    _inverses(data, lights, shading, point)
    for f in range(num_views):
        for i in range(4):
            for a in range(3):
                along, bend = point.along[a * num_views + f], point.bend[f]
                weighted, basis, component = point.weighted[f], point.basis[4 * a + i], shading[i]
                row = point.mixed[4 * f + i, a * num_samples : (a + 1) * num_samples]
                for k in range(num_samples):
                    row[k] = bend[k] * along[k] * component[k] - weighted[k] * basis[k]
            source = point.mixed[4 * f + i]
            for a in range(3):
                target = point.solved[4 * f + i, a * num_samples : (a + 1) * num_samples]
                u, v, w = point.inverse[3 * a], point.inverse[3 * a + 1], point.inverse[3 * a + 2]
                for k in range(num_samples):
                    target[k] = (
                        u[k] * source[k]
                        + v[k] * source[num_samples + k]
                        + w[k] * source[2 * num_samples + k]
                    )
    trace = 0.0
    for i in range(4 * num_views):
        for j in range(i, 4 * num_views):
            value = -_product(point.solved[i], point.mixed[j])
            point.schur[i, j] = value
            point.schur[j, i] = value
    for f in range(num_views):
        for i in range(4):
            for j in range(4):
                total, bend = 0.0, point.bend[f]
                for k in range(num_samples):
                    total += bend[k] * shading[i, k] * shading[j, k]
                point.schur[4 * f + i, 4 * f + j] += total
                if i == j:
                    point.schur[4 * f + i, 4 * f + i] += data.regularization[f]
                    trace += total + data.regularization[f]
    for i in range(4 * num_views):
        point.schur[i, i] += _RIDGE * max(trace / (4 * num_views), 1e-300)


@compiled(fast=True)
def _product(a: Doubles, b: Doubles) -> float:
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@compiled(fast=True)
def _inverses(data: Data, lights: Doubles, shading: Doubles, point: Point) -> None:
    """Invert every sample's block; zero for samples without data, which do not change."""
    num_views = len(lights)
    slope, images = np.empty_like(shading), np.empty_like(point.basis)
    _prior_image(data, shading, slope)
    for a in range(3):
        _prior_image(data, point.basis[4 * a : 4 * a + 4], images[4 * a : 4 * a + 4])
    for k in range(shading.shape[1]):
        g1, g2, g3 = slope[1, k], slope[2, k], slope[3, k]
        m00 = m01 = m02 = m11 = m12 = m22 = 0.0
        for f in range(num_views):
            bend, weighted = point.bend[f, k], point.weighted[f, k]
            u = point.along[f, k]
            v, w = point.along[num_views + f, k], point.along[2 * num_views + f, k]
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
        n, first, second = point.basis[0:4, k], point.basis[4:8, k], point.basis[8:12, k]
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
        bending = per * (g1 * n[1] + g2 * n[2] + g3 * n[3])
        m11 -= bending
        m22 -= bending
        c00, c01, c02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
        determinant = m00 * c00 + m01 * c01 + m02 * c02
        inverse = 1 / determinant if determinant != 0 else 0.0
        point.inverse[0, k] = inverse * c00
        point.inverse[1, k] = point.inverse[3, k] = inverse * c01
        point.inverse[2, k] = point.inverse[6, k] = inverse * c02
        point.inverse[4, k] = inverse * (m00 * m22 - m02 * m02)
        point.inverse[5, k] = point.inverse[7, k] = inverse * (m01 * m02 - m00 * m12)
        point.inverse[8, k] = inverse * (m00 * m11 - m01 * m01)


@compiled(fast=True)
def _solve(point: Point, on_lights: Doubles, on_samples: Doubles) -> bool:
    """Apply the Hessian's inverse to two right-hand sides, in place; False if it is singular.

    Args:
        on_lights: Right-hand side, view, 4.
        on_samples: Right-hand side, tangent, sample.
    """
    num_views, num_samples = on_lights.shape[1], on_samples.shape[2]
    schur, rhs = point.schur.copy(), np.empty((4 * num_views, 2))
    inner = np.empty_like(on_samples)
    for side in range(2):
        for a in range(3):
            for k in range(num_samples):
                inner[side, a, k] = (
                    point.inverse[3 * a, k] * on_samples[side, 0, k]
                    + point.inverse[3 * a + 1, k] * on_samples[side, 1, k]
                    + point.inverse[3 * a + 2, k] * on_samples[side, 2, k]
                )
        for row in range(4 * num_views):
            total = 0.0
            for a in range(3):
                for k in range(num_samples):
                    total += point.mixed[row, a * num_samples + k] * inner[side, a, k]
            rhs[row, side] = on_lights[side, row // 4, row % 4] - total
    if not eliminate(schur, rhs):
        return False
    for side in range(2):
        for row in range(4 * num_views):
            step = rhs[row, side]
            on_lights[side, row // 4, row % 4] = step
            for a in range(3):
                for k in range(num_samples):
                    inner[side, a, k] -= point.solved[row, a * num_samples + k] * step
    overwrite(on_samples[0], inner[0])
    overwrite(on_samples[1], inner[1])
    return True


@compiled(fast=True)
def _by_deviation(point: Point, field: Doubles) -> None:
    """Write the derivative of the weighted residuals by the deviation to ``field``.

    It follows from that by the residuals, because weights depend only on residual over deviation.
    """
    per = 1 / point.numbers[0] if point.numbers[0] > 0 else 0.0
    for f in range(len(field)):
        for k in range(field.shape[1]):
            field[f, k] = per * (point.weighted[f, k] - point.bend[f, k] * point.residual[f, k])


@compiled(fast=True)
def _ambient(point: Point, on_samples: Doubles, ambient: Doubles) -> None:
    """Write the shading vectors of tangent coordinates to ``ambient``."""
    for i in range(4):
        for k in range(on_samples.shape[1]):
            ambient[i, k] = (
                point.basis[i, k] * on_samples[0, k]
                + point.basis[4 + i, k] * on_samples[1, k]
                + point.basis[8 + i, k] * on_samples[2, k]
            )


@compiled(fast=True)
def _corrected(
    point: Point,
    other_lights: Doubles,
    other_samples: Doubles,
    on_lights: Doubles,
    on_samples: Doubles,
) -> bool:
    """Solve with the Hessian and its rank-one term, by the Sherman-Morrison formula.

    Args:
        other_lights: With ``other_samples``, the term's ``p``; the second right-hand side is ``q``.
        on_lights: With ``on_samples``, two right-hand sides; the first is replaced by the solution.
    """
    if not _solve(point, on_lights, on_samples):
        return False
    along = np.sum(other_lights * on_lights[0]) + np.sum(other_samples * on_samples[0])
    remainder = 1 + np.sum(other_lights * on_lights[1]) + np.sum(other_samples * on_samples[1])
    factor = along / remainder if remainder != 0 else 0.0
    on_lights[0] -= factor * on_lights[1]
    on_samples[0] -= factor * on_samples[1]
    return True


@compiled(fast=True)
def _newton_refined(data: Data, lights: Doubles, shading: Doubles, weight: Doubles) -> float:
    """Take Newton steps while they reduce the gradient; return the root mean square residual."""
    num_views, num_samples = data.radiance.shape
    point = _point(num_views, num_samples)
    on_lights, on_samples = np.empty((2, num_views, 4)), np.empty((2, 3, num_samples))
    p_lights, p_samples = np.empty((num_views, 4)), np.empty((3, num_samples))
    field, change = np.empty((num_views, num_samples)), np.zeros((4, num_samples))
    new_lights, new_shading, direction = lights.copy(), shading.copy(), np.zeros((num_views, 4))
    size, fraction, rms = np.inf, 0.5, 0.0
    for _ in range(_STEPS):
        _evaluate(data, new_lights, new_shading, point)
        new_size = _descent(data, new_lights, new_shading, point, on_lights[0], on_samples[0])
        if new_size < size:
            moved_square, square = np.sum((new_lights - lights) ** 2), np.sum(lights**2)
            overwrite(lights, new_lights)
            overwrite(shading, new_shading)
            overwrite(weight, data.given * point.weight)
            first, rms = size == np.inf, point.numbers[1]
            size, fraction = new_size, min(2 * fraction, 1.0)
            if moved_square <= _CLOSE * _CLOSE * square and not first:
                return rms
            _hessian(data, lights, shading, point)
            _by_deviation(point, field)
            _pull(field, lights, shading, point, on_lights[1], on_samples[1])
            _pull(point.by_residual, lights, shading, point, p_lights, p_samples)
            if not _corrected(point, p_lights, p_samples, on_lights, on_samples):
                return rms
            overwrite(direction, on_lights[0])
            _ambient(point, on_samples[0], change)
        else:
            fraction /= 2
            if fraction < _SHORTEST:
                return rms
        new_lights, trial = lights + fraction * direction, shading + fraction * change
        for k in range(num_samples):
            projected = project_to_cone(trial[0, k], trial[1, k], trial[2, k], trial[3, k])
            for i in range(4):
                new_shading[i, k] = projected[i]
    return rms


@compiled(fast=True)
def _pull_back(
    data: Data,
    light: Doubles,
    shade: Doubles,
    p: int,
    views: Integers,
    samples: Integers,
    upstream: FactorSolution,
    result: FactorData,
) -> None:
    num_views, num_samples = len(views), len(samples)
    point = _point(num_views, num_samples)
    _evaluate(data, light, shade, point)
    _hessian(data, light, shade, point)
    deviation, rms, count = point.numbers[0], point.numbers[1], point.numbers[2]
    width = data.scale * deviation
    per_width = 1 / width if width > 0 else 0.0
    per_rms = upstream.residual[p] / (count * rms) if rms > 0 else 0.0
    # Derivatives by weights and residuals, with lights and shading fixed.
    direct, total = np.empty((num_views, num_samples)), 0.0
    for f in range(num_views):
        for k in range(num_samples):
            relative = point.residual[f, k] * per_width
            on_weight = data.given[f, k] * upstream.weight[p, views[f], samples[k]]
            on_relative = 2 * on_weight * point.slope[f, k] * relative
            direct[f, k] = on_relative * per_width
            direct[f, k] += per_rms * data.given[f, k] * point.residual[f, k]
            total -= on_relative * relative
    direct += (total / deviation if deviation > 0 else 0.0) * point.by_residual
    on_lights, on_samples = np.empty((2, num_views, 4)), np.empty((2, 3, num_samples))
    _pull(direct, light, shade, point, on_lights[0], on_samples[0])
    ambient, coordinates = np.empty((4, num_samples)), np.empty((3, num_samples))
    for i in range(4):
        for f in range(num_views):
            on_lights[0, f, i] = upstream.lights[p, views[f], i] - on_lights[0, f, i]
        for k in range(num_samples):
            ambient[i, k] = upstream.shading[p, i, samples[k]]
    _coordinates(point, ambient, coordinates)
    overwrite(on_samples[0], coordinates - on_samples[0])
    q_lights, q_samples = np.empty((num_views, 4)), np.empty((3, num_samples))
    field = np.empty((num_views, num_samples))
    _by_deviation(point, field)
    _pull(field, light, shade, point, q_lights, q_samples)
    _pull(point.by_residual, light, shade, point, on_lights[1], on_samples[1])
    if not _corrected(point, q_lights, q_samples, on_lights, on_samples):
        return
    if not np.sum(np.abs(on_lights[0])) + np.sum(np.abs(on_samples[0])) < _MAX_ADJOINT:
        return
    on_deviation = np.sum(q_lights * on_lights[0]) + np.sum(q_samples * on_samples[0])
    _ambient(point, on_samples[0], ambient)
    for f in range(num_views):
        for k in range(num_samples):
            change = (
                on_lights[0, f, 0] * shade[0, k]
                + on_lights[0, f, 1] * shade[1, k]
                + on_lights[0, f, 2] * shade[2, k]
                + on_lights[0, f, 3] * shade[3, k]
                + light[f, 0] * ambient[0, k]
                + light[f, 1] * ambient[1, k]
                + light[f, 2] * ambient[2, k]
                + light[f, 3] * ambient[3, k]
            )
            r, weight = point.residual[f, k], point.weight[f, k]
            result.radiance[p, views[f], samples[k]] = (
                point.bend[f, k] * change + on_deviation * point.by_residual[f, k] + direct[f, k]
            )
            result.weight[p, views[f], samples[k]] = weight * (
                r * change + upstream.weight[p, views[f], samples[k]]
            ) + 0.5 * per_rms * (r * r - rms * rms)
        for i in range(4):
            result.prior_mean[p, views[f], i] = data.regularization[f] * on_lights[0, f, i]
        result.regularization[p, views[f]] = np.sum(
            on_lights[0, f] * (data.prior_mean[f] - light[f])
        )
    entry = 0
    for i in range(4):
        for j in range(i, 4):
            for k in range(num_samples):
                product = ambient[i, k] * shade[j, k]
                if i != j:
                    product += ambient[j, k] * shade[i, k]
                result.prior[p, entry, samples[k]] = -product
            entry += 1


@compiled()
def _is_prior_mean(problem: FactorData, p: int, f: int) -> bool:
    """Return whether the light of a view is its prior mean, because it has no data."""
    return problem.regularization[p, f] > 0 and not np.any(problem.weight[p, f] > 0)


@compiled(annotated=True)
def refine(
    problem: FactorData, loss: int, scale: float, stride: int, solution: FactorSolution
) -> None:
    """Refine solutions to stationary points by Newton's method; compute weights and residuals.

    Args:
        loss: Code of the loss.
        scale: Of the loss, in standard deviations.
        stride: The deviation is estimated from every ``stride``-th sample.
        solution: Initial lights and shading, updated; weights and residuals, zero before.
    """
    lights, shading, weight, residual = solution
    for p in range(len(lights)):
        for f in range(lights.shape[1]):
            if _is_prior_mean(problem, p, f):
                for i in range(4):
                    lights[p, f, i] = problem.prior_mean[p, f, i]
        views = _views_with_data(problem.weight[p])
        samples, num_scale = samples_that_count(problem.weight[p], stride)
        if len(views) == 0:
            continue
        data = _data(problem, p, views, samples, num_scale, loss, scale)
        light, shade = _start(lights, shading, p, views, samples)
        robust_weight = np.empty(data.given.shape)
        residual[p] = _newton_refined(data, light, shade, robust_weight)
        for f in range(len(views)):
            for k in range(len(samples)):
                weight[p, views[f], samples[k]] = robust_weight[f, k]
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
    upstream: FactorSolution,
    result: FactorData,
) -> None:
    """Compute derivatives by the data from those by the solution, a stationary point.

    Args:
        lights: Of the solution of :func:`refine`, as is ``shading``.
        upstream: Derivatives by the solution.
        result: Zero before; stays zero for a patch with a singular Hessian, such as without albedo.
    """
    for p in range(len(lights)):
        for f in range(lights.shape[1]):
            if _is_prior_mean(problem, p, f):
                for i in range(4):
                    result.prior_mean[p, f, i] = upstream.lights[p, f, i]
        views = _views_with_data(problem.weight[p])
        samples, num_scale = samples_that_count(problem.weight[p], stride)
        if len(views) == 0:
            continue
        data = _data(problem, p, views, samples, num_scale, loss, scale)
        light, shade = _start(lights, shading, p, views, samples)
        _pull_back(data, light, shade, p, views, samples, upstream, result)
