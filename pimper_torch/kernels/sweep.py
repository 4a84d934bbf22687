"""Costs of all heights of a bucket's samples; the twin of what ``sweep.sweep`` does in torch.

What the arguments mean is told there; images are handed over as in ``kernels.resample``.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.lookup import blended_level, corners
from pimper_torch.kernels.switch import compiled

Array = NDArray[Any]

# As often the albedo that suits all views is found anew.
ALBEDO_ROUNDS = 2

# Factors of a product are taken together in one logarithm until it comes near the largest number.
_FULL = 1e200


@compiled(
    "float32(float32[:,::1], float32[:,::1], int64[:,::1], int64, int64, float32,float64, float64)"
)
def _gray(
    finest: Array,
    coarser: Array,
    levels: Array,
    view: int,
    level: int,
    rest: float,
    u: float,
    v: float,
) -> float:
    """Blend the two levels that a sample lies between."""
    total = np.float32(0)
    for step in range(2):
        if step == 1 and rest == 0:
            break
        tall, wide, start = levels[level + step]
        at, aside, down, p, q = corners(
            tall, wide, u * (wide / levels[0, 1]) - 0.5, v * (tall / levels[0, 0]) - 0.5
        )
        if level + step == 0:
            pixels = finest[view]
        else:
            pixels, at = coarser[view], start + at
        above = pixels[at] + p * (pixels[at + aside] - pixels[at])
        at += down
        below = pixels[at] + p * (pixels[at + aside] - pixels[at])
        weight = rest if step == 1 else np.float32(1) - rest
        total += weight * (above + q * (below - above))
    return total


@compiled("float32(float32[::1], int64)")
def _lower_median(values: Array, count: int) -> float:
    """Sort the first few values, and give the middle one, or the lower of two."""
    for last in range(1, count):
        value = values[last]
        place = last
        while place > 0 and values[place - 1] > value:
            values[place] = values[place - 1]
            place -= 1
        values[place] = value
    return values[(count - 1) // 2]


@compiled("float64(float32[::1], float32[::1], int64, float32, float32[::1])")
def _inconsistency(radiance: Array, shading: Array, count: int, scale: float, said: Array) -> float:
    """See :func:`~pimper_torch.sweep.consistency.inconsistency`: of one sample and height."""
    for view in range(count):
        said[view] = radiance[view] / shading[view]
    albedo = _lower_median(said, count)
    one, per_scale = np.float32(1), np.float32(1) / scale
    for _ in range(ALBEDO_ROUNDS):
        square, product = np.float32(0), np.float32(0)
        for view in range(count):
            residual = (radiance[view] - albedo * shading[view]) * per_scale
            lit = shading[view] / (one + residual * residual)
            square += lit * shading[view]
            product += lit * radiance[view]
        albedo = product / square if square > 0 else product
    cost, factors = 0.0, 1.0
    for view in range(count):
        residual = (radiance[view] - albedo * shading[view]) * per_scale
        factors *= 1.0 + np.float64(residual) * np.float64(residual)
        if factors > _FULL:
            cost += math.log(factors)
            factors = 1.0
    return 0.5 * (cost + math.log(factors))


@compiled(
    "void(float32[:,::1], float32[:,::1], int64[:,::1], float64[:,:,::1],"
    "float64[:,::1], float64[::1], float64[:,::1], float64[::1], float32[:,:,::1],"
    "float32[:,:,:,::1], float32[:,:,:,::1], float32[:,:,::1], boolean[:,:,:,::1],"
    "boolean[:,:,::1], float32[::1], float64[::1], int64, int64, float64,"
    "float32[:,:,:,::1], float32[:,:,::1])"
)
def costs(
    finest: Array,
    coarser: Array,
    levels: Array,
    image_from_patch: Array,
    centers_patch: Array,
    focals: Array,
    origin: Array,
    spacing: Array,
    depth: Array,
    outward: Array,
    normals: Array,
    lights: Array,
    valid: Array,
    asked: Array,
    scale: Array,
    ladder: Array,
    num_views: int,
    min_views: int,
    least_facing: float,
    cost: Array,
    swept: Array,
) -> None:
    """Choose the views that judge each sample, and give its cost at all heights.

    Args:
        finest: Gray images, a row a view.
        coarser: Their further levels, one after another.
        levels: Height, width and place of every level.
        image_from_patch: Three by four, for every patch and view.
        centers_patch: Of the cameras, for every patch and view.
        focals: In pixels.
        origin: Of every template.
        spacing: Of every template.
        depth: Of every sample.
        outward: Unit, along which a sample is swept; patch frame.
        normals: That light shades, patch frame.
        lights: First-order harmonics of every patch and view.
        valid: Where a view has the sample.
        asked: Samples that may be swept.
        scale: Of residuals that are large, of every patch.
        ladder: Heights that are tried, in units of ``spacing``.
        num_views: At most so many judge a sample.
        min_views: A sample that fewer views may judge is not swept.
        least_facing: Cosine of the angle from which on footprints shrink no more.
        cost: Zero throughout; filled.
        swept: Zero throughout; 1 where a sample has costs.
    """
    patches, views, height, width = valid.shape
    heights, count_levels = len(ladder), len(levels)
    limit = min(num_views, views)
    shading = np.empty(views, np.float32)
    score = np.empty(limit, np.float32)
    chosen = np.empty(limit, np.int64)
    facings = np.empty(views, np.float64)
    footprints = np.empty(views, np.float64)
    lit = np.empty(limit, np.float32)
    said = np.empty(limit, np.float32)
    radiance = np.empty((heights, limit), np.float32)
    tiny = np.finfo(np.float32).eps
    for patch in range(patches):
        for row in range(height):
            y = origin[patch, 1] + spacing[patch] * row
            for column in range(width):
                if not asked[patch, row, column]:
                    continue
                having = 0
                for view in range(views):
                    having += valid[patch, view, row, column]
                if having < min_views:
                    continue
                x = origin[patch, 0] + spacing[patch] * column
                z = np.float64(depth[patch, row, column])
                ox = np.float64(outward[patch, row, column, 0])
                oy = np.float64(outward[patch, row, column, 1])
                oz = np.float64(outward[patch, row, column, 2])
                typical = np.float32(0)
                for view in range(views):
                    light = lights[patch, view]
                    shade = light[0] + light[1] * normals[patch, row, column, 0]
                    shade += light[2] * normals[patch, row, column, 1]
                    shade += light[3] * normals[patch, row, column, 2]
                    shading[view] = shade
                    typical += max(shade, np.float32(0))
                typical /= np.float32(views)
                found = 0
                for view in range(views):
                    if not valid[patch, view, row, column] or not shading[view] > 0:
                        continue
                    away = centers_patch[patch * views + view]
                    a, b, c = away[0] - x, away[1] - y, away[2] - z
                    facing = a * ox + b * oy + c * oz
                    if not facing > 0:
                        continue
                    facing /= math.sqrt(a * a + b * b + c * c)
                    m = image_from_patch[patch * views + view]
                    far = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                    footprint = spacing[patch] * focals[view] / max(far, tiny)
                    facings[view], footprints[view] = facing, footprint
                    rated = facing * min(footprint, 1.0) * min(shading[view] / typical, 1.0)
                    rated = np.float32(rated)
                    if found == limit and not rated > score[limit - 1]:
                        continue
                    place = min(found, limit - 1)
                    while place > 0 and score[place - 1] < rated:
                        score[place], chosen[place] = score[place - 1], chosen[place - 1]
                        place -= 1
                    score[place], chosen[place] = rated, view
                    found = min(found + 1, limit)
                if found < min_views:
                    continue
                for slot in range(found):
                    view = chosen[slot]
                    lit[slot] = shading[view]
                    m = image_from_patch[patch * views + view]
                    u0 = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
                    v0 = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
                    w0 = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                    du = m[0, 0] * ox + m[0, 1] * oy + m[0, 2] * oz
                    dv = m[1, 0] * ox + m[1, 1] * oy + m[1, 2] * oz
                    dw = m[2, 0] * ox + m[2, 1] * oy + m[2, 2] * oz
                    squeezed = max(facings[view], least_facing)
                    footprint = footprints[view]
                    level, rest = blended_level(footprint * footprint * squeezed, count_levels)
                    for step in range(heights):
                        move = spacing[patch] * ladder[step]
                        far = w0 + move * dw
                        near = 1 / far if far != 0 else 1.0
                        radiance[step, slot] = _gray(
                            finest,
                            coarser,
                            levels,
                            view,
                            level,
                            rest,
                            near * (u0 + move * du),
                            near * (v0 + move * dv),
                        )
                swept[patch, row, column] = 1
                for step in range(heights):
                    cost[patch, step, row, column] = _inconsistency(
                        radiance[step], lit, found, scale[patch], said
                    )
