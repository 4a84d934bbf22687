"""Adjoint of :mod:`pimper_torch.stages.sweep.kernels.sweep_costs`."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels import signatures
from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.lookup import shrinkage
from pimper_torch.kernels.lookup_adjoint import spread
from pimper_torch.stages.sweep.kernels.sweep_costs import (
    FLOOR,
    Shading,
    Trial,
    choose,
    empty_choice,
    look_up,
    trace,
)

Array = NDArray[Any]


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


@compiled(
    "float64(float32[:,::1], int64, float32[::1], float32[::1], int64, float32, float32[::1],"
    "int64[::1], float32, float32[:,::1], float32[::1])",
    fast=True,
)
def _inconsistency(
    radiance: Array,
    step: int,
    shading: Array,
    per_shading: Array,
    count: int,
    per_scale: float,
    ratios: Array,
    order: Array,
    on_cost: float,
    on_radiance: Array,
    on_shading: Array,
) -> float:
    """Compute the derivatives of the cost of one sample and height.

    Args:
        on_radiance: Result, of this step.
        on_shading: Added to.

    Returns:
        The derivative by ``per_scale``.
    """
    zero, one, two = np.float32(0), np.float32(1), np.float32(2)
    if on_cost == 0:
        on_radiance[step] = 0
        return 0.0
    for view in range(count):
        ratios[view] = radiance[step, view] * per_shading[view]
    first = np.float32(_lower_median(ratios, order, count))
    median = order[(count - 1) // 2]
    square, product = zero, zero
    for view in range(count):
        residual = (radiance[step, view] - first * shading[view]) * per_scale
        lit = shading[view] / (one + residual * residual)
        square += lit * shading[view]
        product += lit * radiance[step, view]
    per_first = one / square if square > 0 else one
    falls = square > 0
    second = product * per_first
    square, product = zero, zero
    for view in range(count):
        residual = (radiance[step, view] - second * shading[view]) * per_scale
        lit = shading[view] / (one + residual * residual)
        square += lit * shading[view]
        product += lit * radiance[step, view]
    per_second = one / square if square > 0 else one
    third = product * per_second
    on_scale, on_albedo = zero, zero
    for view in range(count):
        error = radiance[step, view] - third * shading[view]
        residual = error * per_scale
        on_residual = on_cost * residual / (one + residual * residual)
        on_radiance[step, view] = on_residual * per_scale
        on_shading[view] -= on_residual * per_scale * third
        on_albedo -= on_residual * per_scale * shading[view]
        on_scale += on_residual * error
    falls_second = square > 0
    for iteration in range(2):
        albedo = second if iteration == 0 else first
        mean = third if iteration == 0 else second
        on_product = on_albedo * (per_second if iteration == 0 else per_first)
        on_square = -on_product * mean if (falls_second if iteration == 0 else falls) else zero
        on_albedo = zero
        for view in range(count):
            error = radiance[step, view] - albedo * shading[view]
            residual = error * per_scale
            weight = one / (one + residual * residual)
            lit = shading[view] * weight
            on_lit = on_square * shading[view] + on_product * radiance[step, view]
            on_residual = -two * residual * on_lit * lit * weight
            on_radiance[step, view] += on_product * lit + on_residual * per_scale
            on_shading[view] += on_square * lit + on_lit * weight - on_residual * per_scale * albedo
            on_albedo -= on_residual * per_scale * shading[view]
            on_scale += on_residual * error
    on_radiance[step, median] += on_albedo * per_shading[median]
    on_shading[median] -= on_albedo * per_shading[median] * first
    return float(on_scale)


@compiled(annotated=True)
def pull_back(
    gray: signatures.PictureRows,
    levels: signatures.Integers2,
    projection: signatures.Projection,
    focals: signatures.Doubles1,
    samples: signatures.Samples,
    shaded: Shading,
    trial: Trial,
    on_cost: signatures.Floats4,
    on_pixels: int,
    gradients: CostGradients,
) -> None:
    """Compute derivatives by pictures, geometry and light from those by the costs.

    The choice of a sample's views and of their median is held constant.

    Args:
        on_pixels: Whether derivatives by pictures are needed, 1 or 0.
        gradients: Added to.
    """
    patches, views, height, width = trial.valid.shape
    heights, limit = len(trial.ladder), min(trial.num_views, views)
    choice = empty_choice(views, limit)
    lit = np.empty(limit, np.float32)
    per_lit = np.empty(limit, np.float32)
    ratios = np.empty(limit, np.float32)
    order = np.empty(limit, np.int64)
    fractions = shrinkage(levels)
    radiance = np.empty((heights, limit), np.float32)
    on_radiance = np.empty((heights, limit), np.float32)
    on_lit = np.empty(limit, np.float32)
    paths = np.empty((limit, 2, 3))
    areas = np.empty(limit)
    on_channel = np.empty(1, np.float32)
    point, on_point = np.empty(3), np.empty(3)
    along, on_along = np.empty(3), np.empty(3)
    on_path = np.empty((2, 3))
    for patch in range(patches):
        spacing = samples.spacing[patch]
        per_scale = np.float32(1) / trial.scale[patch]
        on_per_scale = 0.0
        for row in range(height):
            for column in range(width):
                if not np.any(on_cost[patch, :, row, column] != 0):
                    continue
                count = choose(
                    patch, row, column, projection, focals, samples, shaded, trial, choice
                )
                if count == 0:
                    continue
                for slot in range(count):
                    view = choice.views[slot]
                    lit[slot] = choice.shading[view]
                    per_lit[slot] = np.float32(1) / choice.shading[view]
                    order[slot] = slot
                    on_lit[slot] = 0
                    m = projection.image_from_patch[patch * views + view]
                    trace(m, samples, patch, row, column, paths[slot])
                    footprint = choice.footprints[view]
                    bounded = max(choice.facings[view], trial.min_facing)
                    areas[slot] = footprint * footprint * bounded
                    look_up(
                        gray,
                        levels,
                        fractions,
                        projection.rows[view],
                        paths[slot],
                        spacing,
                        trial.ladder,
                        areas[slot],
                        shaded.gains[patch, view],
                        radiance[:, slot],
                    )
                for step in range(heights):
                    on_per_scale += _inconsistency(
                        radiance,
                        step,
                        lit,
                        per_lit,
                        count,
                        per_scale,
                        ratios,
                        order,
                        on_cost[patch, step, row, column],
                        on_radiance,
                        on_lit,
                    )
                point[0] = samples.origin[patch, 0] + spacing * column
                point[1] = samples.origin[patch, 1] + spacing * row
                point[2] = samples.depth[patch, row, column]
                on_point[:], on_along[:] = 0, 0
                for axis in range(3):
                    along[axis] = samples.outward[patch, row, column, axis]
                normal = shaded.normals[patch, row, column]
                on_normal = gradients.normals[patch, row, column]
                on_spacing = 0.0
                for slot in range(count):
                    view = choice.views[slot]
                    index = patch * views + view
                    gain = shaded.gains[patch, view]
                    path = paths[slot]
                    on_path[:] = 0
                    on_level, on_gain = 0.0, 0.0
                    for step in range(heights):
                        on_sample = on_radiance[step, slot]
                        if on_sample == 0:
                            continue
                        on_gain += on_sample * radiance[step, slot]
                        on_channel[0] = on_sample * gain
                        move = spacing * trial.ladder[step]
                        z_cam = path[0, 2] + move * path[1, 2]
                        inverse_z = 1 / z_cam if z_cam != 0 else 1.0
                        u = inverse_z * (path[0, 0] + move * path[1, 0])
                        v = inverse_z * (path[0, 1] + move * path[1, 1])
                        on_u, on_v, by_level = spread(
                            gray.finest,
                            gray.coarser,
                            gradients.finest,
                            gradients.coarser,
                            levels,
                            fractions,
                            projection.rows[view],
                            u,
                            v,
                            areas[slot],
                            on_channel,
                            on_pixels > 0,
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
                        gradients.gains[patch, view] += on_gain / gain
                    # The level is the logarithm of the footprint plus half that of the facing.
                    on_level /= math.log(2)
                    on_spacing += on_level / spacing
                    gradients.focals[view] += on_level / focals[view]
                    if path[0, 2] > FLOOR:
                        on_path[0, 2] -= on_level / path[0, 2]
                    facing = choice.facings[view]
                    if facing > trial.min_facing:
                        on_facing = 0.5 * on_level / facing
                        center = projection.centers_patch[index]
                        distance = 0.0
                        for axis in range(3):
                            distance += (center[axis] - point[axis]) ** 2
                        distance = math.sqrt(distance)
                        for axis in range(3):
                            direction = (center[axis] - point[axis]) / distance
                            on_along[axis] += on_facing * direction
                            on_center = on_facing * (along[axis] - facing * direction) / distance
                            gradients.centers_patch[index, axis] += on_center
                            on_point[axis] -= on_center
                    m, by_m = projection.image_from_patch[index], gradients.image_from_patch[index]
                    for i in range(3):
                        for axis in range(3):
                            on_point[axis] += on_path[0, i] * m[i, axis]
                            on_along[axis] += on_path[1, i] * m[i, axis]
                            by_m[i, axis] += on_path[0, i] * point[axis]
                            by_m[i, axis] += on_path[1, i] * along[axis]
                        by_m[i, 3] += on_path[0, i]
                    on_light, light = gradients.lights[patch, view], shaded.lights[patch, view]
                    on_light[0] += on_lit[slot]
                    for axis in range(3):
                        on_light[1 + axis] += on_lit[slot] * normal[axis]
                        on_normal[axis] += on_lit[slot] * light[1 + axis]
                gradients.origin[patch, 0] += on_point[0]
                gradients.origin[patch, 1] += on_point[1]
                gradients.depth[patch, row, column] += on_point[2]
                gradients.spacing[patch] += on_spacing + on_point[0] * column + on_point[1] * row
                for axis in range(3):
                    gradients.outward[patch, row, column, axis] += on_along[axis]
        gradients.scale[patch] -= on_per_scale * per_scale * per_scale
