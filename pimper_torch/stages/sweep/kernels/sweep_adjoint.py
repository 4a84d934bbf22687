"""Adjoint of :mod:`pimper_torch.stages.sweep.kernels.sweep_costs`."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels import signatures
from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.lookup import shrinkage
from pimper_torch.kernels.lookup_adjoint import pull_back_lookup
from pimper_torch.stages.sweep.kernels.sweep_costs import (
    FLOOR,
    Choice,
    Ray,
    Sample,
    Sweep,
    choose_views,
    empty_choice,
    position,
    sample_ray,
    sample_view,
)

Array = NDArray[Any]
# Radiance and shading of the views of a sample, their number, and the inverse scale of the loss.
Seen = tuple[Array, Array, int, float]
# Number of chosen views; radiance, height by view; derivatives by it and by shading; paths; areas.
Sampled = tuple[int, Array, Array, Array, Array, Array]
# See `_refit`.
Fit = tuple[Any, Any, Any]


class CostGradients(NamedTuple):
    """Derivatives by pictures, and by the other arguments of the costs."""

    finest: signatures.Floats2
    coarser: signatures.Floats2
    image_from_patch: signatures.Doubles3
    centers_patch: signatures.Doubles2
    focals: signatures.Doubles1
    origin: signatures.Doubles2
    spacing: signatures.Doubles1
    depth: signatures.Doubles3
    outward: signatures.Doubles4
    normals: signatures.Doubles4
    lights: signatures.Doubles3
    gains: signatures.Doubles2
    scale: signatures.Doubles1


@compiled("float32(float32[::1], int64[::1], int64)")
def _lower_median(values: Array, order: Array, count: int) -> float:
    """Return the lower median of the first ``count`` values, and sort ``order`` by them.

    By insertion sort: linear time if ``order`` is nearly sorted.
    """
    for last in range(1, count):
        candidate = order[last]
        index = last
        while index > 0 and values[order[index - 1]] > values[candidate]:
            order[index] = order[index - 1]
            index -= 1
        order[index] = candidate
    return values[order[(count - 1) // 2]]


@compiled(fast=True)
def _refit(seen: Seen, albedo: Any) -> Fit:  # noqa: ANN401 - numbers of numpy
    """Fit the albedo with the weights of its residuals.

    Returns:
        The new albedo; the inverse of the normal equation's coefficient, and whether it is regular.
    """
    radiance, shading, count, per_scale = seen
    zero, one = np.float32(0), np.float32(1)
    square, product = zero, zero
    for view in range(count):
        residual = (radiance[view] - albedo * shading[view]) * per_scale
        lit = shading[view] / (one + residual * residual)
        square += lit * shading[view]
        product += lit * radiance[view]
    inverse = one / square if square > 0 else one
    return product * inverse, inverse, square > 0


@compiled(fast=True)
def _pull_back_refit(
    seen: Seen,
    albedo: Any,  # noqa: ANN401 - numbers of numpy
    fit: Fit,
    on_fit: Any,  # noqa: ANN401
    on_scale: Any,  # noqa: ANN401
    on_radiance: Array,
    on_shading: Array,
) -> tuple[Any, Any]:
    """Add derivatives by the arguments of :func:`_refit`; return those by albedo and scale.

    Args:
        fit: Its result.
        on_fit: Derivative by the new albedo.
        on_scale: Added to.
    """
    radiance, shading, count, per_scale = seen
    one, two = np.float32(1), np.float32(2)
    fitted, inverse, regular = fit
    on_product = on_fit * inverse
    on_square = -on_product * fitted if regular else np.float32(0)
    on_albedo = np.float32(0)
    for view in range(count):
        error = radiance[view] - albedo * shading[view]
        residual = error * per_scale
        weight = one / (one + residual * residual)
        lit = shading[view] * weight
        on_lit = on_square * shading[view] + on_product * radiance[view]
        on_residual = -two * residual * on_lit * lit * weight
        on_radiance[view] += on_product * lit + on_residual * per_scale
        on_shading[view] += on_square * lit + on_lit * weight - on_residual * per_scale * albedo
        on_albedo -= on_residual * per_scale * shading[view]
        on_scale += on_residual * error
    return on_albedo, on_scale


@compiled(
    "float64(Tuple((float32[::1], float32[::1], int64, float32)), float32[::1], float32[::1],"
    "int64[::1], float32, float32[::1], float32[::1])",
    fast=True,
)
def _pull_back_cost(
    seen: Seen,
    per_shading: Array,
    ratios: Array,
    order: Array,
    on_cost: float,
    on_radiance: Array,
    on_shading: Array,
) -> float:
    """Compute the derivatives of the cost of one sample and height.

    Args:
        on_radiance: Result.
        on_shading: Added to.

    Returns:
        The derivative by ``per_scale``.
    """
    radiance, shading, count, per_scale = seen
    zero, one = np.float32(0), np.float32(1)
    if on_cost == 0:
        on_radiance[:] = 0
        return 0.0
    for view in range(count):
        ratios[view] = radiance[view] * per_shading[view]
    first = np.float32(_lower_median(ratios, order, count))
    median = order[(count - 1) // 2]
    second = _refit(seen, first)
    third = _refit(seen, second[0])
    on_scale, on_albedo = zero, zero
    for view in range(count):
        error = radiance[view] - third[0] * shading[view]
        residual = error * per_scale
        on_residual = on_cost * residual / (one + residual * residual)
        on_radiance[view] = on_residual * per_scale
        on_shading[view] -= on_residual * per_scale * third[0]
        on_albedo -= on_residual * per_scale * shading[view]
        on_scale += on_residual * error
    for albedo, fit in ((second[0], third), (first, second)):
        on_albedo, on_scale = _pull_back_refit(
            seen, albedo, fit, on_albedo, on_scale, on_radiance, on_shading
        )
    on_radiance[median] += on_albedo * per_shading[median]
    on_shading[median] -= on_albedo * per_shading[median] * first
    return float(on_scale)


@compiled()
def _pull_back_lookups(
    sweep: Sweep,
    fractions: Array,
    index: tuple[int, int],
    seen: tuple[Array, Array, Array, float],
    on_pixels: int,
    on_spacing: float,
    gradients: CostGradients,
) -> tuple[Array, float, float]:
    """Add derivatives by a view's pixels and gain.

    Args:
        index: Of patch and view.
        seen: Radiance at all heights, derivatives by it, the path, and the area of the footprint.
        on_spacing: Added to.

    Returns:
        Derivatives by the path, the level of the pyramid, and the spacing.
    """
    gray, levels, projection, _, samples, shaded, trial = sweep
    radiance, on_radiance, path, area = seen
    spacing, gain = samples.spacing[index[0]], shaded.gains[index]
    on_gray = gradients.finest, gradients.coarser
    on_path, on_channel = np.zeros((2, 3)), np.empty(1, np.float32)
    on_level, on_gain = 0.0, 0.0
    for step in range(len(trial.ladder)):
        if on_radiance[step] == 0:
            continue
        on_gain += on_radiance[step] * radiance[step]
        on_channel[0] = on_radiance[step] * gain
        move = spacing * trial.ladder[step]
        z_cam, inverse_z, u, v = position(path, move)
        place = projection.rows[index[1]], u, v, area
        on_u, on_v, by_level = pull_back_lookup(
            gray, on_gray, levels, fractions, place, on_channel, on_pixels > 0
        )
        on_level += by_level
        if z_cam == 0:
            continue  # no position in the picture
        a, b = on_u * inverse_z, on_v * inverse_z
        c = -(a * u + b * v)
        on_path[0, 0] += a
        on_path[0, 1] += b
        on_path[0, 2] += c
        on_path[1, 0] += a * move
        on_path[1, 1] += b * move
        on_path[1, 2] += c * move
        on_move = a * path[1, 0] + b * path[1, 1] + c * path[1, 2]
        on_spacing += on_move * trial.ladder[step]
    if gain != 0:
        gradients.gains[index] += on_gain / gain
    return on_path, on_level, on_spacing


@compiled()
def _pull_back_facing(
    center: Array, ray: Ray, facing: float, on_facing: float, on_center: Array, on_ray: Array
) -> None:
    """Add derivatives of a facing by the camera's centre, the sample and its outward normal."""
    point, along = ray
    distance = 0.0
    for axis in range(3):
        distance += (center[axis] - point[axis]) ** 2
    distance = math.sqrt(distance)
    for axis in range(3):
        direction = (center[axis] - point[axis]) / distance
        on_ray[1, axis] += on_facing * direction
        change = on_facing * (along[axis] - facing * direction) / distance
        on_center[axis] += change
        on_ray[0, axis] -= change


@compiled()
def _pull_back_path(m: Array, ray: Ray, on_path: Array, by_m: Array, on_ray: Array) -> None:
    """Add derivatives of a path by the projection, the sample and its outward normal."""
    for i in range(3):
        for axis in range(3):
            for k in range(2):
                on_ray[k, axis] += on_path[k, i] * m[i, axis]
                by_m[i, axis] += on_path[k, i] * ray[k][axis]
        by_m[i, 3] += on_path[0, i]


@compiled()
def _pull_back_view(
    sweep: Sweep,
    sample: Sample,
    view: int,
    facing: float,
    path: Array,
    on_path: Array,
    on_level: float,
    on_lit: float,
    on_ray: Array,
    gradients: CostGradients,
) -> None:
    """Add derivatives by a chosen view's footprint, projection and shading."""
    patch, row, column = sample
    index = patch * len(sweep.focals) + view
    ray = sample_ray(sweep.samples, sample)
    gradients.focals[view] += on_level / sweep.focals[view]
    if path[0, 2] > FLOOR:
        on_path[0, 2] -= on_level / path[0, 2]
    if facing > sweep.trial.min_facing:
        center, on_center = sweep.projection.centers_patch[index], gradients.centers_patch[index]
        _pull_back_facing(center, ray, facing, 0.5 * on_level / facing, on_center, on_ray)
    m, by_m = sweep.projection.image_from_patch[index], gradients.image_from_patch[index]
    _pull_back_path(m, ray, on_path, by_m, on_ray)
    on_light, light = gradients.lights[patch, view], sweep.shaded.lights[patch, view]
    on_light[0] += on_lit
    for axis in range(3):
        on_light[1 + axis] += on_lit * sweep.shaded.normals[patch, row, column, axis]
        gradients.normals[patch, row, column, axis] += on_lit * light[1 + axis]


@compiled()
def _pull_back_sample(
    sweep: Sweep,
    fractions: Array,
    sample: Sample,
    choice: Choice,
    sampled: Sampled,
    on_pixels: int,
    gradients: CostGradients,
) -> None:
    """Add derivatives of the radiance and shading of a sample's chosen views."""
    patch, row, column = sample
    count, radiance, on_radiance, on_lit, paths, areas = sampled
    on_ray, on_spacing = np.zeros((2, 3)), 0.0
    for slot in range(count):
        view, path = choice.views[slot], paths[slot]
        seen = radiance[:, slot], on_radiance[:, slot], path, areas[slot]
        on_path, on_level, on_spacing = _pull_back_lookups(
            sweep, fractions, (patch, view), seen, on_pixels, on_spacing, gradients
        )
        # The level is the logarithm of the footprint plus half that of the facing.
        on_level /= math.log(2)
        on_spacing += on_level / sweep.samples.spacing[patch]
        facing, on_shade = choice.facings[view], on_lit[slot]
        _pull_back_view(
            sweep, sample, view, facing, path, on_path, on_level, on_shade, on_ray, gradients
        )
    gradients.origin[patch, 0] += on_ray[0, 0]
    gradients.origin[patch, 1] += on_ray[0, 1]
    gradients.depth[patch, row, column] += on_ray[0, 2]
    gradients.spacing[patch] += on_spacing + on_ray[0, 0] * column + on_ray[0, 1] * row
    for axis in range(3):
        gradients.outward[patch, row, column, axis] += on_ray[1, axis]


@compiled(annotated=True)
def pull_back_costs(
    sweep: Sweep, on_cost: signatures.Floats4, on_pixels: int, gradients: CostGradients
) -> None:
    """Compute derivatives by pictures, geometry and light from those by the costs.

    The choice of a sample's views and of their median is held constant.

    Args:
        on_pixels: Whether derivatives by pictures are needed, 1 or 0.
        gradients: Added to.
    """
    trial = sweep.trial
    patches, views, height, width = trial.valid.shape
    heights, limit = len(trial.ladder), min(trial.num_views, views)
    choice, fractions = empty_choice(views, limit), shrinkage(sweep.levels)
    radiance = np.empty((heights, limit), np.float32)
    on_radiance = np.empty((heights, limit), np.float32)
    ratios, order = np.empty(limit, np.float32), np.empty(limit, np.int64)
    on_lit, paths, areas = np.empty(limit, np.float32), np.empty((limit, 2, 3)), np.empty(limit)
    for patch in range(patches):
        per_scale = np.float32(1) / trial.scale[patch]
        on_per_scale = 0.0
        for row in range(height):
            for column in range(width):
                sample = patch, row, column
                if not np.any(on_cost[patch, :, row, column] != 0):
                    continue
                count = choose_views(sweep, sample, choice)
                if count == 0:
                    continue
                for slot in range(count):
                    order[slot], on_lit[slot] = slot, 0
                    path, values = paths[slot], radiance[:, slot]
                    areas[slot] = sample_view(sweep, fractions, sample, choice, slot, path, values)
                for step in range(heights):
                    seen = radiance[step], choice.lit, count, per_scale
                    on_step, upstream = on_radiance[step], on_cost[patch, step, row, column]
                    on_per_scale += _pull_back_cost(
                        seen, choice.per_lit, ratios, order, upstream, on_step, on_lit
                    )
                sampled = count, radiance, on_radiance, on_lit, paths, areas
                _pull_back_sample(sweep, fractions, sample, choice, sampled, on_pixels, gradients)
        gradients.scale[patch] -= on_per_scale * per_scale * per_scale
