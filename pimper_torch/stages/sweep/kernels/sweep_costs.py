"""Costs of all height hypotheses of a bucket's samples: twin of ``stages.sweep.sweep``.

Arguments are documented there; pyramids are stored as in ``patches.kernels.resampling``.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels import signatures
from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.lookup import bilinear, blended_level, corners, shrinkage

Array = NDArray[Any]
# Indices: patch, row, column.
Sample = tuple[int, int, int]
Vector = tuple[float, float, float]
Ray = tuple[Vector, Vector]

FLOOR = float(np.finfo(np.float32).eps)


@compiled()
def _gray(pixels: Array, levels: Array, fractions: Array, level: int, u: float, v: float) -> float:
    """Sample one level of a photograph's pyramid."""
    tall, wide = levels[level, 0], levels[level, 1]
    x, y = u * fractions[level, 1] - 0.5, v * fractions[level, 0] - 0.5
    index, right, below, across, down = corners(tall, wide, x, y)
    start = levels[level, 2] if level > 0 else 0
    return bilinear(pixels, start + index, right, below, across, down)


@compiled(fast=True)
def _inconsistency(
    radiance: Array,
    shading: Array,
    per_shading: Array,
    count: int,
    per_scale: float,
    ranked: Array,
    work: tuple[Array, Array, Array, Array],
    cost: Array,
) -> None:
    """See :func:`~pimper_torch.stages.sweep.costs.inconsistency`; for one sample.

    The inner loops run over the heights, to be vectorized.
    """
    albedo, square, product, factors = work
    heights, middle, one = len(cost), (count - 1) // 2, np.float32(1)
    # The lower median, by insertion.
    for view in range(count):
        for step in range(heights):
            albedo[step] = radiance[view, step] * per_shading[view]
        for rank in range(min(view, middle + 1)):
            for step in range(heights):
                first, second = ranked[rank, step], albedo[step]
                ranked[rank, step], albedo[step] = min(first, second), max(first, second)
        if view <= middle:
            for step in range(heights):
                ranked[view, step] = albedo[step]
    for step in range(heights):
        albedo[step] = ranked[middle, step]
    for _ in range(2):
        for step in range(heights):
            square[step], product[step] = 0, 0
        for view in range(count):
            for step in range(heights):
                residual = (radiance[view, step] - albedo[step] * shading[view]) * per_scale
                lit = shading[view] / (one + residual * residual)
                square[step] += lit * shading[view]
                product[step] += lit * radiance[view, step]
        for step in range(heights):
            albedo[step] = product[step] / (square[step] if square[step] > 0 else one)
    for step in range(heights):
        cost[step] = 0
    for start in range(0, count, 8):  # products of eight do not overflow
        for step in range(heights):
            factors[step] = 1
        for view in range(start, min(start + 8, count)):
            for step in range(heights):
                residual = (radiance[view, step] - albedo[step] * shading[view]) * per_scale
                factors[step] *= 1.0 + np.float64(residual) * np.float64(residual)
        for step in range(heights):
            cost[step] += 0.5 * math.log(factors[step])


@compiled("int64(float32[::1], int64[::1], float32[::1])")
def _demote_repeated_poses(ratings: Array, poses: Array, demoted: Array) -> int:
    """See :func:`~pimper_torch.stages.sweep.costs.poses_first`; views of rating 0 are not usable.

    Returns:
        Number of poses with a usable view.
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
    """Normals, lights of every patch and view, and factors of radiance."""

    normals: signatures.Floats4
    lights: signatures.Floats3
    gains: signatures.Floats2


class Trial(NamedTuple):
    """Height hypotheses of every sample, and the limits of the views that evaluate them.

    Attributes:
        tested: Samples that may be swept.
        valid: Whether a view has the sample.
        scale: Of the robust loss, for every patch.
        ladder: Heights in units of the samples' spacing.
        poses: Pose index of each view; empty if all poses differ.
        num_views: Maximum number of views of a sample.
        min_views: A sample with fewer views is not swept.
        min_facing: Lower bound of the cosine that shrinks footprints.
    """

    tested: signatures.Masks3
    valid: signatures.Masks4
    scale: signatures.Floats1
    ladder: signatures.Doubles1
    poses: signatures.Integers1
    num_views: int
    min_views: int
    min_facing: float


class Sweep(NamedTuple):
    """A bucket of samples, the photographs, and the height hypotheses.

    Attributes:
        levels: Height, width and offset of every level.
        focals: Focal length of every view, pixels.
    """

    gray: signatures.PictureRows
    levels: signatures.Integers2
    projection: signatures.Projection
    focals: signatures.Doubles1
    samples: signatures.Samples
    shaded: Shading
    trial: Trial


class Choice(NamedTuple):
    """Chosen views of a sample, and workspace to choose them.

    Attributes:
        views: Chosen views, best first.
        score: Of these.
        lit: Shading of these.
        per_lit: Its inverse.
        shading: Of albedo 1, in every view; facings and footprints are set for candidates only.
        ratings: Of every view; 0 if it is no candidate.
        demoted: Ratings, minus one for each better view of the same pose.
    """

    views: signatures.Integers1
    score: signatures.Floats1
    lit: signatures.Floats1
    per_lit: signatures.Floats1
    shading: signatures.Floats1
    facings: signatures.Doubles1
    footprints: signatures.Doubles1
    ratings: signatures.Floats1
    demoted: signatures.Floats1


@compiled()
def empty_choice(views: int, limit: int) -> Choice:
    """Return an uninitialized choice of at most ``limit`` of the views."""
    return Choice(
        np.empty(limit, np.int64),
        np.empty(limit, np.float32),
        np.empty(limit, np.float32),
        np.empty(limit, np.float32),
        np.empty(views, np.float32),
        np.empty(views, np.float64),
        np.empty(views, np.float64),
        np.empty(views, np.float32),
        np.empty(views, np.float32),
    )


@compiled()
def sample_ray(samples: signatures.Samples, sample: Sample) -> Ray:
    """Return a sample and its outward normal, patch frame."""
    patch, row, column = sample
    origin, spacing, depth, outward = samples
    x = origin[patch, 0] + spacing[patch] * column
    y = origin[patch, 1] + spacing[patch] * row
    z = np.float64(depth[patch, row, column])
    ox = np.float64(outward[patch, row, column, 0])
    oy = np.float64(outward[patch, row, column, 1])
    oz = np.float64(outward[patch, row, column, 2])
    return (x, y, z), (ox, oy, oz)


@compiled()
def _shade(shaded: Shading, sample: Sample, shading: Array) -> float:
    """Compute the shading of albedo 1 in every view; return its mean, negative values as zero."""
    patch, row, column = sample
    normals, lights, _ = shaded
    mean_shading: Any = np.float32(0)
    for view in range(len(shading)):
        light = lights[patch, view]
        shade = light[0] + light[1] * normals[patch, row, column, 0]
        shade += light[2] * normals[patch, row, column, 1]
        shade += light[3] * normals[patch, row, column, 2]
        shading[view] = shade
        mean_shading += max(shade, np.float32(0))
    mean_shading /= np.float32(len(shading))
    return mean_shading


@compiled()
def _rate(sweep: Sweep, sample: Sample, choice: Choice) -> None:
    """Rate every view of a sample: by its angle, resolution and light."""
    patch, row, column = sample
    _, image_from_patch, centers_patch = sweep.projection
    shading, ratings = choice.shading, choice.ratings
    spacing, valid, focals = sweep.samples.spacing, sweep.trial.valid, sweep.focals
    (x, y, z), (ox, oy, oz) = sample_ray(sweep.samples, sample)
    mean_shading = _shade(sweep.shaded, sample, shading)
    views = len(shading)
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
        footprint = spacing[patch] * focals[view] / max(z_cam, FLOOR)
        choice.facings[view], choice.footprints[view] = facing, footprint
        rating = facing * min(footprint, 1.0) * min(shading[view] / mean_shading, 1.0)
        ratings[view] = np.float32(rating)


@compiled()
def _take_best(choice: Choice) -> int:
    """Write the views of the largest demoted ratings in order; return their number."""
    chosen, score, limit = choice.views, choice.score, len(choice.views)
    num_chosen = 0
    for view in range(len(choice.demoted)):
        rating = choice.demoted[view]
        if not choice.ratings[view] > 0:
            continue
        if num_chosen == limit and not rating > score[limit - 1]:
            continue
        index = min(num_chosen, limit - 1)
        while index > 0 and score[index - 1] < rating:
            score[index], chosen[index] = score[index - 1], chosen[index - 1]
            index -= 1
        score[index], chosen[index] = rating, view
        num_chosen = min(num_chosen + 1, limit)
    return num_chosen


@compiled()
def choose_views(sweep: Sweep, sample: Sample, choice: Choice) -> int:
    """Choose the views of a sample.

    Returns:
        Their number; 0 if the sample is not swept.
    """
    patch, row, column = sample
    tested, valid, _, _, poses, _, min_views, _ = sweep.trial
    if not tested[patch, row, column]:
        return 0
    num_valid = 0
    for view in range(len(choice.shading)):
        num_valid += valid[patch, view, row, column]
    if num_valid < min_views:
        return 0
    _rate(sweep, sample, choice)
    num_distinct = _demote_repeated_poses(choice.ratings, poses, choice.demoted)
    num_chosen = _take_best(choice)
    for slot in range(num_chosen):
        choice.lit[slot] = choice.shading[choice.views[slot]]
        choice.per_lit[slot] = np.float32(1) / choice.lit[slot]
    return num_chosen if min(num_chosen, num_distinct) >= min_views else 0


@compiled()
def position(path: Array, move: float) -> tuple[float, float, float, float]:
    """Return depth, inverse depth (1 for zero), and pixel of a point moved along its path."""
    z_cam = path[0, 2] + move * path[1, 2]
    inverse_z = 1 / z_cam if z_cam != 0 else 1.0
    u = inverse_z * (path[0, 0] + move * path[1, 0])
    v = inverse_z * (path[0, 1] + move * path[1, 1])
    return z_cam, inverse_z, u, v


@compiled()
def sample_view(
    sweep: Sweep,
    fractions: Array,
    sample: Sample,
    choice: Choice,
    slot: int,
    path: Array,
    radiance: Array,
) -> float:
    """Sample a chosen view at all heights of a sample.

    Args:
        fractions: See :func:`~pimper_torch.kernels.lookup.shrinkage`.
        path: Result: homogeneous projections of the sample and of its outward normal.
        radiance: Result: the photograph over the view's exposure, for every height.

    Returns:
        The area of the sample's footprint, pixels.
    """
    gray, levels, projection, _, samples, shaded, trial = sweep
    patch, view = sample[0], choice.views[slot]
    m = projection.image_from_patch[patch * len(choice.shading) + view]
    (x, y, z), (ox, oy, oz) = sample_ray(samples, sample)
    for i in range(3):
        path[0, i] = m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3]
        path[1, i] = m[i, 0] * ox + m[i, 1] * oy + m[i, 2] * oz
    footprint = choice.footprints[view]
    area = footprint * footprint * max(choice.facings[view], trial.min_facing)
    level, blend = blended_level(area, len(levels))
    coarse = gray.coarser[projection.rows[view]]
    fine = coarse if level > 0 else gray.finest[projection.rows[view]]
    coarser_level = level + (1 if blend > 0 else 0)
    spacing, gain = samples.spacing[patch], shaded.gains[patch, view]
    for step in range(len(trial.ladder)):
        _, _, u, v = position(path, spacing * trial.ladder[step])
        value = _gray(fine, levels, fractions, level, u, v)
        if blend > 0:
            value += blend * (_gray(coarse, levels, fractions, coarser_level, u, v) - value)
        radiance[step] = gain * value
    return area


@compiled(annotated=True)
def costs(sweep: Sweep, cost: signatures.Floats4, swept: signatures.Floats3) -> None:
    """Choose the views of each sample, and evaluate its cost at all heights.

    Args:
        swept: Result, zero before: 1 for samples with costs.
    """
    trial = sweep.trial
    patches, views, height, width = trial.valid.shape
    heights, limit = len(trial.ladder), min(trial.num_views, views)
    choice, fractions = empty_choice(views, limit), shrinkage(sweep.levels)
    radiance = np.empty((limit, heights), np.float32)
    ranked = np.empty((limit, heights), np.float32)
    albedo, square = np.empty(heights, np.float32), np.empty(heights, np.float32)
    product = np.empty(heights, np.float32)
    work, evaluated = (albedo, square, product, np.empty(heights)), np.empty(heights)
    path = np.empty((2, 3))
    for patch in range(patches):
        per_scale = np.float32(1) / trial.scale[patch]
        for row in range(height):
            for column in range(width):
                sample = patch, row, column
                count = choose_views(sweep, sample, choice)
                if count == 0:
                    continue
                for slot in range(count):
                    sample_view(sweep, fractions, sample, choice, slot, path, radiance[slot])
                swept[patch, row, column] = 1
                lit, per_lit = choice.lit, choice.per_lit
                _inconsistency(radiance, lit, per_lit, count, per_scale, ranked, work, evaluated)
                for step in range(heights):
                    cost[patch, step, row, column] = evaluated[step]
