"""Costs of all height hypotheses of a bucket's samples: twin of ``sweep.sweep``.

Arguments are documented there; images are laid out as in ``kernels.resampling``.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.arrays import (
    Doubles1,
    Floats1,
    Floats2,
    Floats3,
    Floats4,
    Integers1,
    Integers2,
    Masks3,
    Masks4,
    PictureRows,
    Projection,
    Samples,
)
from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.lookup import bilinear, blended_level, corners, shrinkage

Array = NDArray[Any]


@compiled(
    "float32(float32[:,::1], float32[:,::1], int64[:,::1], float64[:,::1], int64, int64, float32,"
    "float64, float64)"
)
def _gray(
    finest: Array,
    coarser: Array,
    levels: Array,
    fractions: Array,
    view: int,
    level: int,
    blend: float,
    u: float,
    v: float,
) -> float:
    """Sample the pyramid trilinearly."""
    tall, wide = levels[level, 0], levels[level, 1]
    index = corners(tall, wide, u * fractions[level, 1] - 0.5, v * fractions[level, 0] - 0.5)
    at, right, below, across, down = index
    if level == 0:
        value = bilinear(finest, view, at, right, below, across, down)
    else:
        value = bilinear(coarser, view, levels[level, 2] + at, right, below, across, down)
    if blend > 0:
        level += 1
        tall, wide = levels[level, 0], levels[level, 1]
        index = corners(tall, wide, u * fractions[level, 1] - 0.5, v * fractions[level, 0] - 0.5)
        at, right, below, across, down = index
        coarser_value = bilinear(coarser, view, levels[level, 2] + at, right, below, across, down)
        value += blend * (coarser_value - value)
    return value


@compiled("float32(float32[::1], int64[::1], int64)")
def _lower_median(values: Array, order: Array, count: int) -> float:
    """Return the lower median of the first ``count`` values.

    By insertion sort of ``order``: linear time if it is nearly sorted.
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
    "int64[::1])",
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
) -> float:
    """See :func:`~pimper_torch.sweep.costs.inconsistency`; for one sample and height."""
    for view in range(count):
        ratios[view] = radiance[step, view] * per_shading[view]
    albedo = np.float32(_lower_median(ratios, order, count))
    one = np.float32(1)
    for _ in range(2):
        square, product = np.float32(0), np.float32(0)
        for view in range(count):
            residual = (radiance[step, view] - albedo * shading[view]) * per_scale
            lit = shading[view] / (one + residual * residual)
            square += lit * shading[view]
            product += lit * radiance[step, view]
        albedo = product / square if square > 0 else product
    cost = 0.0
    for first in range(0, count, 8):  # products of eight do not overflow
        factors = 1.0
        for view in range(first, min(first + 8, count)):
            residual = (radiance[step, view] - albedo * shading[view]) * per_scale
            factors *= 1.0 + np.float64(residual) * np.float64(residual)
        cost += math.log(factors)
    return 0.5 * cost


@compiled("int64(float32[::1], int64[::1], float32[::1])")
def _after_other_poses(ratings: Array, poses: Array, demoted: Array) -> int:
    """See :func:`~pimper_torch.sweep.costs.poses_first`; views of rating 0 are not usable.

    Returns:
        How many poses have a usable view.
    """
    distinct = 0
    for view in range(len(ratings)):
        better = 0
        if ratings[view] > 0 and len(poses):
            for other in range(len(ratings)):
                if poses[other] == poses[view] and (
                    ratings[other] > ratings[view]
                    or (ratings[other] == ratings[view] and other < view)
                ):
                    better += 1
        demoted[view] = ratings[view] - np.float32(better)
        distinct += ratings[view] > 0 and better == 0
    return distinct


class Shading(NamedTuple):
    """Normals that light shades, lights of every patch and view, and factors of radiance."""

    normals: Floats4
    lights: Floats3
    gains: Floats2


class Trial(NamedTuple):
    """The heights of every sample that are tried.

    Attributes:
        tested: Samples that may be swept.
        valid: Where a view has the sample.
        scale: Of the robust loss, for every patch.
        ladder: In units of the samples' spacing.
        poses: Number of each view's pose; empty where every view has its own.
        num_views: Maximum number of views of a sample.
        min_views: A sample with fewer views is not swept.
        min_facing: Lower bound of the cosine that shrinks footprints.
    """

    tested: Masks3
    valid: Masks4
    scale: Floats1
    ladder: Doubles1
    poses: Integers1
    num_views: int
    min_views: int
    min_facing: float


@compiled(annotated=True)
def costs(
    gray: PictureRows,
    levels: Integers2,
    projection: Projection,
    focals: Doubles1,
    samples: Samples,
    shaded: Shading,
    trial: Trial,
    cost: Floats4,
    swept: Floats3,
) -> None:
    """Choose the views of each sample, and evaluate its cost at all heights.

    Args:
        levels: Height, width and offset of every level.
        swept: Result, zero before: 1 where a sample has costs.
    """
    rows, image_from_patch, centers_patch = projection
    origin, spacing, depth, outward = samples
    normals, lights, gains = shaded
    tested, valid, scale, ladder, poses, num_views, min_views, min_facing = trial
    finest, coarser = gray
    patches, views, height, width = valid.shape
    heights, count_levels = len(ladder), len(levels)
    limit = min(num_views, views)
    shading = np.empty(views, np.float32)
    score = np.empty(limit, np.float32)
    chosen = np.empty(limit, np.int64)
    ratings = np.empty(views, np.float32)
    demoted = np.empty(views, np.float32)
    facings = np.empty(views, np.float64)
    footprints = np.empty(views, np.float64)
    lit = np.empty(limit, np.float32)
    per_lit = np.empty(limit, np.float32)
    ratios = np.empty(limit, np.float32)
    order = np.empty(limit, np.int64)
    fractions = shrinkage(levels)
    radiance = np.empty((heights, limit), np.float32)
    tiny = np.finfo(np.float32).eps
    for patch in range(patches):
        for row in range(height):
            y = origin[patch, 1] + spacing[patch] * row
            for column in range(width):
                if not tested[patch, row, column]:
                    continue
                num_valid = 0
                for view in range(views):
                    num_valid += valid[patch, view, row, column]
                if num_valid < min_views:
                    continue
                x = origin[patch, 0] + spacing[patch] * column
                z = np.float64(depth[patch, row, column])
                ox = np.float64(outward[patch, row, column, 0])
                oy = np.float64(outward[patch, row, column, 1])
                oz = np.float64(outward[patch, row, column, 2])
                mean_shading = np.float32(0)
                for view in range(views):
                    light = lights[patch, view]
                    shade = light[0] + light[1] * normals[patch, row, column, 0]
                    shade += light[2] * normals[patch, row, column, 1]
                    shade += light[3] * normals[patch, row, column, 2]
                    shading[view] = shade
                    mean_shading += max(shade, np.float32(0))
                mean_shading /= np.float32(views)
                for view in range(views):
                    ratings[view] = 0
                    if not valid[patch, view, row, column] or not shading[view] > 0:
                        continue
                    center = centers_patch[patch * views + view]
                    a, b, c = center[0] - x, center[1] - y, center[2] - z
                    facing = a * ox + b * oy + c * oz
                    if not facing > 0:
                        continue
                    facing /= math.sqrt(a * a + b * b + c * c)
                    m = image_from_patch[patch * views + view]
                    z_cam = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                    footprint = spacing[patch] * focals[view] / max(z_cam, tiny)
                    facings[view], footprints[view] = facing, footprint
                    rating = facing * min(footprint, 1.0) * min(shading[view] / mean_shading, 1.0)
                    ratings[view] = np.float32(rating)
                num_distinct = _after_other_poses(ratings, poses, demoted)
                num_chosen = 0
                for view in range(views):
                    rating = demoted[view]
                    if not ratings[view] > 0:
                        continue
                    if num_chosen == limit and not rating > score[limit - 1]:
                        continue
                    index = min(num_chosen, limit - 1)
                    while index > 0 and score[index - 1] < rating:
                        score[index], chosen[index] = score[index - 1], chosen[index - 1]
                        index -= 1
                    score[index], chosen[index] = rating, view
                    num_chosen = min(num_chosen + 1, limit)
                if min(num_chosen, num_distinct) < min_views:
                    continue
                for slot in range(num_chosen):
                    view = chosen[slot]
                    lit[slot] = shading[view]
                    per_lit[slot] = np.float32(1) / shading[view]
                    order[slot] = slot
                    m = image_from_patch[patch * views + view]
                    u0 = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
                    v0 = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
                    w0 = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                    du = m[0, 0] * ox + m[0, 1] * oy + m[0, 2] * oz
                    dv = m[1, 0] * ox + m[1, 1] * oy + m[1, 2] * oz
                    dw = m[2, 0] * ox + m[2, 1] * oy + m[2, 2] * oz
                    bounded = max(facings[view], min_facing)
                    footprint = footprints[view]
                    level, blend = blended_level(footprint * footprint * bounded, count_levels)
                    for step in range(heights):
                        move = spacing[patch] * ladder[step]
                        z_cam = w0 + move * dw
                        inverse_z = 1 / z_cam if z_cam != 0 else 1.0
                        radiance[step, slot] = gains[patch, view] * _gray(
                            finest,
                            coarser,
                            levels,
                            fractions,
                            rows[view],
                            level,
                            blend,
                            inverse_z * (u0 + move * du),
                            inverse_z * (v0 + move * dv),
                        )
                swept[patch, row, column] = 1
                per_scale = np.float32(1) / scale[patch]
                for step in range(heights):
                    cost[patch, step, row, column] = _inconsistency(
                        radiance, step, lit, per_lit, num_chosen, per_scale, ratios, order
                    )
