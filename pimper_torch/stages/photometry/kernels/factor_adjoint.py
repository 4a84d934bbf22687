"""Derivatives of factorizations on the cone: twin of ``stages.photometry.factor_gradients``.

One patch at a time is packed, in float64. Let ``G`` be minus half
the gradient of the objective, with a scale of the robust weights that depends on the residuals.
Then ``dG = -(H - q p^T) dx`` plus the derivative by the data. ``H`` is the Hessian, ``q`` the
derivative of ``G`` by the residuals' deviation, and ``p`` that of the deviation by the unknowns
``x``: lights, and coordinates of samples along their tangents.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.dense_systems import eliminate
from pimper_torch.kernels.signatures import Doubles3
from pimper_torch.stages.photometry.kernels import residuals, shading_steps
from pimper_torch.stages.photometry.kernels.packed_patches import (
    FactorData,
    FactorSolution,
    Patch,
    Selection,
    copy_unseen,
    gathered,
    packed,
    scattered,
    selected,
)
from pimper_torch.stages.photometry.kernels.shading_steps import COLUMNS, ROWS

Doubles = NDArray[np.float64]

# Maximum number of Newton steps, minimum fraction of a step, and the step relative to the unknowns
# that ends them: choices; few patches need more than five.
_STEPS, _SHORTEST, _CLOSE = 30, 1e-3, 1e-11

# Added to the lights' Hessian, as a fraction of its mean diagonal: undetermined directions, such as
# Lorentz transformations of free lights, do not change.
_RIDGE = 1e-10

# A patch with a larger adjoint counts as singular: products would exceed the range of float32.
_MAX_ADJOINT = 1e25


class Point(NamedTuple):
    """Lights and shading, and derivatives there; entries are view by sample.

    Attributes:
        deviation: Of the residuals.
        weighted: Residual times all weights.
        bend: Second derivative of the loss.
        by_residual: Derivative of the deviation by each residual.
        basis: Tangents: row ``4 a + i`` is component ``i`` of tangent ``a``.
    """

    lights: Doubles
    shading: Doubles
    deviation: float
    weighted: Doubles
    bend: Doubles
    by_residual: Doubles
    basis: Doubles


class Hessian(NamedTuple):
    """The Hessian of lights and of samples along their tangents.

    Attributes:
        inverse: Inverse of every sample's block, packed.
        mixed: Block of lights and samples: ``4 views`` by ``3 samples``, ordered by tangent.
        schur: Schur complement of the samples.
    """

    inverse: Doubles
    mixed: Doubles
    schur: Doubles


@compiled(fast=True)
def _evaluate(patch: Patch, lights: Doubles, shading: Doubles) -> Point:
    deviation, scale = residuals.update_weights(patch, lights, shading, 0.0, np.float64)
    width = patch.scale * deviation
    inverse = 1 / width if width > 0 else 0.0
    bend, by_residual = np.empty_like(patch.weight), np.zeros_like(patch.weight)
    for f in range(len(lights)):
        for k in range(shading.shape[1]):
            square = (patch.residual[f, k] * inverse) ** 2
            weight, slope = residuals.weighed(patch.loss, patch.given[f, k], square, 1.0)
            bend[f, k] = weight + 2 * square * slope
    if deviation > patch.min_deviation:
        _deviation_slopes(patch, deviation, scale, by_residual)
    basis = np.empty((12, shading.shape[1]))
    for k in range(shading.shape[1]):
        axes = shading_steps.frame(shading_steps.vector_at(shading, k))
        for a in range(3):
            basis[4 * a, k] = 1.0 if a == 0 else 0.0
            for i in range(3):
                basis[4 * a + 1 + i, k] = axes[a][i]
    weighted = patch.weight * patch.residual
    return Point(lights, shading, deviation, weighted, bend, by_residual, basis)


@compiled(fast=True)
def _deviation_slopes(patch: Patch, deviation: float, scale: float, by_residual: Doubles) -> None:
    """Write the derivatives of the deviation by the residuals, zero before."""
    total = 0.0
    for f in range(len(by_residual)):
        for k in range(patch.num_scale):
            if patch.given[f, k] > 0:
                r = patch.residual[f, k]
                ratio = min(r * r / scale, 1e9)
                fraction = ratio * ratio / (1 + ratio * ratio)
                total += fraction * (1 - fraction)
                by_residual[f, k] = ratio * r / scale / (1 + ratio * ratio) ** 2
    for f in range(len(by_residual)):
        for k in range(patch.num_scale):
            by_residual[f, k] *= deviation / total if total > 0 else 0.0


@compiled(fast=True)
def _pull(point: Point, field: Doubles, ambient: Doubles) -> Doubles:
    """Return derivatives by the unknowns: lights by view, then samples by tangent.

    They are the sums over samples of shading times a field, and the sums over views of light times
    the field, added to ``ambient``, in the tangents' coordinates.
    """
    num_views, num_samples = field.shape
    result, basis = np.empty(4 * num_views + 3 * num_samples), point.basis
    for f in range(num_views):
        for i in range(4):
            result[4 * f + i] = _product(field[f], point.shading[i])
            for k in range(num_samples):
                ambient[i, k] += point.lights[f, i] * field[f, k]
    for a in range(3):
        target = result[4 * num_views + a * num_samples :]
        for k in range(num_samples):
            target[k] = (
                basis[4 * a, k] * ambient[0, k]
                + basis[4 * a + 1, k] * ambient[1, k]
                + basis[4 * a + 2, k] * ambient[2, k]
                + basis[4 * a + 3, k] * ambient[3, k]
            )
    return result


@compiled(fast=True)
def _product(a: Doubles, b: Doubles) -> float:
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@compiled(fast=True)
def _descent(patch: Patch, point: Point) -> Doubles:
    """Return minus half the gradient.

    The patch's right-hand sides become minus half the derivative by shading vectors.
    """
    ambient, lights = patch.equations[10:], point.lights
    for k in range(ambient.shape[1]):
        prior = shading_steps.matrix_at(patch.prior, k)
        image = shading_steps.apply(prior, shading_steps.vector_at(point.shading, k))
        for i in range(4):
            ambient[i, k] = -image[i]
    result = _pull(point, point.weighted, ambient)
    for f in range(len(lights)):
        for i in range(4):
            difference = lights[f, i] - patch.prior_mean[f, i]
            result[4 * f + i] -= patch.regularization[f] * difference
    return result


@compiled(fast=True)
def _hessian(patch: Patch, point: Point) -> Hessian:
    """Compute the Hessian; the patch's right-hand sides are those of :func:`_descent`."""
    lights, shading, _, weighted, bend, _, basis = point
    num_views, num_samples = bend.shape
    shading_steps.matrices_of_samples(patch.prior, lights, bend, patch.equations)
    inverse, along = np.empty((6, num_samples)), np.empty(num_samples)
    for k in range(num_samples):
        block = _inverse_block(patch.equations, shading_steps.vector_at(shading, k), k)
        for entry in range(6):
            inverse[entry, k] = block[entry]
    mixed = np.empty((4 * num_views, 3 * num_samples))
    for f in range(num_views):
        for a in range(3):
            for k in range(num_samples):
                along[k] = bend[f, k] * (
                    lights[f, 0] * basis[4 * a, k]
                    + lights[f, 1] * basis[4 * a + 1, k]
                    + lights[f, 2] * basis[4 * a + 2, k]
                    + lights[f, 3] * basis[4 * a + 3, k]
                )
            for i in range(4):
                component, tangent, factor = shading[i], basis[4 * a + i], weighted[f]
                row = mixed[4 * f + i, a * num_samples : (a + 1) * num_samples]
                for k in range(num_samples):
                    row[k] = along[k] * component[k] - factor[k] * tangent[k]
    return Hessian(inverse, mixed, _complement(patch, point, inverse, mixed))


@compiled(fast=True)
def _complement(patch: Patch, point: Point, inverse: Doubles, mixed: Doubles) -> Doubles:
    """Return the lights' block minus that of the eliminated samples."""
    size, trace = len(mixed), 0.0
    schur, solved = np.empty((size, size)), np.empty(mixed.shape[1])
    for i in range(size):
        _apply_blocks(inverse, mixed[i], solved)
        for j in range(i, size):
            schur[i, j] = schur[j, i] = -_product(solved, mixed[j])
    for f in range(len(point.lights)):
        bend = point.bend[f]
        for i in range(4):
            for j in range(4):
                first, second = point.shading[i], point.shading[j]
                total = patch.regularization[f] if i == j else 0.0
                for k in range(len(bend)):
                    total += bend[k] * first[k] * second[k]
                trace += total if i == j else 0.0
                schur[4 * f + i, 4 * f + j] += total
    for i in range(size):
        schur[i, i] += _RIDGE * max(trace / size, 1e-300)
    return schur


@compiled(fast=True)
def _inverse_block(equations: Doubles, s: shading_steps.Four, k: int) -> shading_steps.Six:
    """Return the inverse of a sample's block, packed; zero without data: it does not change."""
    n, first, second = shading_steps.frame(s)
    a, b, c, d, e, f = shading_steps.congruence(
        shading_steps.matrix_at(equations, k), n, first, second
    )
    per = 1 / s[0] if s[0] > 0 else 1.0
    descent = equations[11, k], equations[12, k], equations[13, k]
    b -= per * _dot(first, descent)
    c -= per * _dot(second, descent)
    d += per * _dot(n, descent)
    f += per * _dot(n, descent)
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * p + b * q + c * r
    inverse = 1 / determinant if determinant != 0 else 0.0
    return (
        inverse * p,
        inverse * q,
        inverse * r,
        inverse * (a * f - c * c),
        inverse * (b * c - a * e),
        inverse * (a * d - b * b),
    )


@compiled(fast=True)
def _dot(a: shading_steps.Three, b: shading_steps.Three) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled(fast=True)
def _apply_blocks(inverse: Doubles, source: Doubles, target: Doubles) -> None:
    """Write the samples' inverse blocks times their coordinates to ``target``."""
    size = inverse.shape[1]
    a, b, c, d, e, f = inverse[0], inverse[1], inverse[2], inverse[3], inverse[4], inverse[5]
    u, v, w = source[:size], source[size : 2 * size], source[2 * size :]
    for k in range(size):
        target[k] = a[k] * u[k] + b[k] * v[k] + c[k] * w[k]
    for k in range(size):
        target[size + k] = b[k] * u[k] + d[k] * v[k] + e[k] * w[k]
    for k in range(size):
        target[2 * size + k] = c[k] * u[k] + e[k] * v[k] + f[k] * w[k]


@compiled(fast=True)
def _solve(hessian: Hessian, sides: tuple[Doubles, Doubles]) -> bool:
    """Apply the Hessian's inverse to two right-hand sides, in place; False if it is singular."""
    size = len(hessian.schur)
    schur, rhs = hessian.schur.copy(), np.empty((size, 2))
    inner = np.empty(hessian.mixed.shape[1])
    for side in range(2):
        _apply_blocks(hessian.inverse, sides[side][size:], inner)
        for row in range(size):
            rhs[row, side] = sides[side][row] - _product(hessian.mixed[row], inner)
    if not eliminate(schur, rhs):
        return False
    for side in range(2):
        samples = sides[side][size:]
        for row in range(size):
            step, mixed = rhs[row, side], hessian.mixed[row]
            sides[side][row] = step
            for k in range(len(samples)):
                samples[k] -= mixed[k] * step
        _apply_blocks(hessian.inverse, samples.copy(), samples)
    return True


@compiled(fast=True)
def _newton_step(patch: Patch, point: Point, side: Doubles, transposed: bool) -> tuple[bool, float]:
    """Solve with the Hessian and its rank-one term in place, by the Sherman-Morrison formula.

    Args:
        transposed: Whether to solve with the transpose.

    Returns:
        False if the Hessian is singular, and the solution's product with the term's second vector.
    """
    # Weights depend on residual over deviation only: hence their derivative by the deviation.
    per = 1 / point.deviation if point.deviation > 0 else 0.0
    by_deviation = per * (point.weighted - point.bend * patch.residual)
    q = _pull(point, by_deviation, np.zeros_like(point.shading))
    p = _pull(point, point.by_residual, np.zeros_like(point.shading))
    if transposed:
        p, q = q, p
    if not _solve(_hessian(patch, point), (side, q)):
        return False, 0.0
    remainder = 1 + _product(p, q)
    factor = _product(p, side) / remainder if remainder != 0 else 0.0
    for k in range(len(side)):
        side[k] -= factor * q[k]
    return True, _product(p, side)


@compiled(fast=True)
def _ambient(point: Point, step: Doubles) -> Doubles:
    """Return the shading vectors of a step of all unknowns along the tangents."""
    size, basis = point.shading.shape[1], point.basis
    u, v, w = step[-3 * size : -2 * size], step[-2 * size : -size], step[-size:]
    ambient = np.empty_like(point.shading)
    for i in range(4):
        for k in range(size):
            ambient[i, k] = basis[i, k] * u[k] + basis[4 + i, k] * v[k] + basis[8 + i, k] * w[k]
    return ambient


@compiled(fast=True)
def _refined(patch: Patch, lights: Doubles, shading: Doubles) -> tuple[Doubles, Doubles]:
    """Take Newton steps while they reduce the gradient."""
    step, change = np.zeros(lights.size), np.zeros_like(shading)
    new_lights, new_shading = lights, shading
    size, fraction = np.inf, 0.5
    for _ in range(_STEPS):
        point = _evaluate(patch, new_lights, new_shading)
        descent = _descent(patch, point)
        new_size = _product(descent, descent)
        if new_size < size:
            moved_square, square = np.sum((new_lights - lights) ** 2), np.sum(lights**2)
            first, lights, shading = size == np.inf, new_lights, new_shading
            size, fraction = new_size, min(2 * fraction, 1.0)
            if moved_square <= _CLOSE * _CLOSE * square and not first:
                break
            regular, _ = _newton_step(patch, point, descent, False)
            if not regular:
                break
            step, change = descent, _ambient(point, descent)
        else:
            fraction /= 2
            if fraction < _SHORTEST:
                break
        new_lights = lights + fraction * step[: lights.size].reshape(lights.shape)
        new_shading = shading + fraction * change
        for k in range(shading.shape[1]):
            b, x, y, z = shading_steps.vector_at(new_shading, k)
            projected = shading_steps.project_to_cone(b, x, y, z)
            for i in range(4):
                new_shading[i, k] = projected[i]
    return lights, shading


@compiled(fast=True)
def _direct(
    patch: Patch, point: Point, per_rms: float, selection: Selection, upstream: FactorSolution
) -> Doubles:
    """Return derivatives by residuals, through weights and residuals at constant factors."""
    p, views, samples, _ = selection
    width = patch.scale * point.deviation
    inverse = 1 / width if width > 0 else 0.0
    direct, total = np.empty_like(point.bend), 0.0
    for f in range(len(direct)):
        for k in range(direct.shape[1]):
            given, residual = patch.given[f, k], patch.residual[f, k]
            relative = residual * inverse
            _, slope = residuals.weighed(patch.loss, given, relative * relative, 1.0)
            on_relative = 2 * upstream.weight[p, views[f], samples[k]] * slope * relative
            direct[f, k] = on_relative * inverse + per_rms * given * residual
            total -= on_relative * relative
    return direct + (total / point.deviation if total != 0 else 0.0) * point.by_residual


@compiled(fast=True)
def _pull_back(
    patch: Patch,
    point: Point,
    selection: Selection,
    upstream: FactorSolution,
    result: FactorData,
) -> None:
    p, views, samples, _ = selection
    rms, count = residuals.residual_size(patch)
    per_rms = upstream.residual[p] / (count * rms) if rms > 0 else 0.0
    direct = _direct(patch, point, per_rms, selection, upstream)
    on_lights, ambient = gathered(upstream.lights, upstream.shading, selection, len(samples))
    side = _pull(point, -direct, ambient)
    side[: on_lights.size] += on_lights.ravel()
    _descent(patch, point)
    regular, on_deviation = _newton_step(patch, point, side, True)
    if not regular or not np.sum(np.abs(side)) < _MAX_ADJOINT:
        return
    direct += on_deviation * point.by_residual
    on_lights = side[: on_lights.size].copy().reshape(on_lights.shape)
    ambient = _ambient(point, side)
    width = patch.scale * point.deviation
    inverse = 1 / width if width > 0 else 0.0
    for f in range(len(views)):
        for k in range(len(samples)):
            change, r = 0.0, patch.residual[f, k]
            for i in range(4):
                change += on_lights[f, i] * point.shading[i, k] + point.lights[f, i] * ambient[i, k]
            result.radiance[p, views[f], samples[k]] = point.bend[f, k] * change + direct[f, k]
            weight, _ = residuals.weighed(patch.loss, 1.0, (r * inverse) ** 2, 1.0)
            result.given[p, views[f], samples[k]] = weight * (
                r * change + upstream.weight[p, views[f], samples[k]]
            ) + 0.5 * per_rms * (r * r - rms * rms)
    _pull_back_priors(patch, point, on_lights, ambient, selection, result)


@compiled(fast=True)
def _pull_back_priors(
    patch: Patch,
    point: Point,
    on_lights: Doubles,
    ambient: Doubles,
    selection: Selection,
    result: FactorData,
) -> None:
    """Write the derivatives by the priors, from the adjoint of lights and shading."""
    p, views, samples, _ = selection
    for f in range(len(views)):
        for i in range(4):
            result.prior_mean[p, views[f], i] = patch.regularization[f] * on_lights[f, i]
            difference = patch.prior_mean[f, i] - point.lights[f, i]
            result.regularization[p, views[f]] += on_lights[f, i] * difference
    for entry in range(10):
        i, j = ROWS[entry], COLUMNS[entry]
        for k in range(len(samples)):
            product = ambient[i, k] * point.shading[j, k]
            if i != j:
                product += ambient[j, k] * point.shading[i, k]
            result.prior[p, entry, samples[k]] = -product


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
    for p in range(len(problem.given)):
        copy_unseen(problem, p, problem.prior_mean, solution.lights)
        selection = selected(problem, p, stride)
        patch = packed(problem, selection, 1, loss, scale)
        num_samples = len(selection.samples)
        light, shade = gathered(solution.lights, solution.shading, selection, num_samples)
        light, shade = _refined(patch, light, shade)
        residuals.update_weights(patch, light, shade, 0.0, np.float64)
        solution.residual[p], _ = residuals.residual_size(patch)
        scattered(solution, selection, patch.weight, light, shade)


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
        copy_unseen(problem, p, upstream.lights, result.prior_mean)
        selection = selected(problem, p, stride)
        patch = packed(problem, selection, 1, loss, scale)
        light, shade = gathered(lights, shading, selection, len(selection.samples))
        _pull_back(patch, _evaluate(patch, light, shade), selection, upstream, result)
