"""All views of a bucket of templates in one pass; the twin of what ``patches.warp`` does in torch.

What is handed over is documented there and in ``patches.sources``: pyramids are rows of pixels,
the finest level by itself, ``levels`` lists their height, width and the places of their planes.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.lookup import bilinear, blended_level, corners, shrinkage
from pimper_torch.kernels.switch import compiled

Array = NDArray[Any]


@compiled(
    "void(float32[:,::1], float32[:,::1], uint8[:,::1], uint8[:,::1], int64[:,::1],"
    "float64[:,:,::1], float64[:,::1], int64[:,::1], float64[:,::1], float64[::1],"
    "float32[:,:,::1], float32[:,:,:,::1], boolean[:,:,::1], float64, float64,"
    "float32[:,:,:,:,::1], boolean[:,:,:,::1])"
)
def register(
    finest: Array,
    coarser: Array,
    unusable_finest: Array,
    unusable_coarser: Array,
    levels: Array,
    image_from_patch: Array,
    centers_patch: Array,
    sizes_px: Array,
    origin: Array,
    spacing: Array,
    depth: Array,
    outward: Array,
    inside: Array,
    min_facing: float,
    dark_level: float,
    radiance: Array,
    valid: Array,
) -> None:
    """Resample, and say what is missing but for what is hidden.

    Args:
        finest: Images, a row a view.
        coarser: Their further levels, one after another.
        unusable_finest: Fraction of every pixel that is unusable, in 255ths.
        unusable_coarser: Of further levels.
        levels: Height, width and where its planes start in a row of ``coarser``, counted in
            planes' pixels: that of one channel.
        image_from_patch: Three by four, for every patch and view.
        centers_patch: Of the cameras, for every patch and view.
        sizes_px: Of the views.
        origin: Of every template.
        spacing: Of every template.
        depth: Of every sample.
        outward: Unit normals, patch frame.
        inside: Samples that are asked for.
        min_facing: Cosine of the steepest angle.
        dark_level: Of the mean over the channels.
        radiance: Filled.
        valid: Filled.
    """
    patches, views, channels, height, width = radiance.shape
    fine_plane = levels[0, 0] * levels[0, 1]
    count = len(levels)
    fractions = shrinkage(levels)
    pixels = np.empty((height, width, 2), np.float64)
    wanted = np.empty((height, width), np.bool_)
    found = np.empty(channels, np.float32)
    steepest = min_facing * min_facing
    for patch in range(patches):
        for view in range(views):
            m = image_from_patch[patch * views + view]
            away = centers_patch[patch * views + view]
            some = False
            for row in range(height):
                y = origin[patch, 1] + spacing[patch] * row
                for column in range(width):
                    wanted[row, column] = False
                    if not inside[patch, row, column]:
                        continue
                    x = origin[patch, 0] + spacing[patch] * column
                    z = depth[patch, row, column]
                    a, b, c = away[0] - x, away[1] - y, away[2] - z
                    facing = a * outward[patch, row, column, 0]
                    facing += b * outward[patch, row, column, 1]
                    facing += c * outward[patch, row, column, 2]
                    if facing > 0 and facing * facing > steepest * (a * a + b * b + c * c):
                        wanted[row, column] = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] > 0
                        some = some or wanted[row, column]
            if not some:
                radiance[patch, view] = 0
                valid[patch, view] = False
                continue
            for row in range(height):
                y = origin[patch, 1] + spacing[patch] * row
                for column in range(width):
                    x = origin[patch, 0] + spacing[patch] * column
                    z = depth[patch, row, column]
                    far = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                    near = 1 / far if far != 0 else 1.0
                    pixels[row, column, 0] = near * (
                        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
                    )
                    pixels[row, column, 1] = near * (
                        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
                    )
            for row in range(height):
                # The last difference is repeated, and is none along a single sample.
                above = max(0, min(row, height - 2))
                below = min(above + 1, height - 1)
                for column in range(width):
                    usable = False
                    if wanted[row, column]:
                        u, v = pixels[row, column, 0], pixels[row, column, 1]
                        left = max(0, min(column, width - 2))
                        right = min(left + 1, width - 1)
                        ux = pixels[row, right, 0] - pixels[row, left, 0]
                        vx = pixels[row, right, 1] - pixels[row, left, 1]
                        uy = pixels[below, column, 0] - pixels[above, column, 0]
                        vy = pixels[below, column, 1] - pixels[above, column, 1]
                        area = max(1.0, abs(ux * vy - vx * uy))
                        margin = 0.5 * math.sqrt(area)
                        if (
                            margin <= u <= sizes_px[view, 0] - margin
                            and margin <= v <= sizes_px[view, 1] - margin
                        ):
                            level, rest = blended_level(area, count)
                            lost = np.float32(0)
                            for step in range(2 if rest > 0 else 1):
                                weight = rest if step == 1 else np.float32(1) - rest
                                here = level + step
                                tall, wide = levels[here, 0], levels[here, 1]
                                at, aside, down, p, q = corners(
                                    tall,
                                    wide,
                                    u * fractions[here, 1] - 0.5,
                                    v * fractions[here, 0] - 0.5,
                                )
                                if here == 0:
                                    lost += weight * bilinear(
                                        unusable_finest, view, at, aside, down, p, q
                                    )
                                    for channel in range(channels):
                                        found[channel] = weight * bilinear(
                                            finest, view, at, aside, down, p, q
                                        )
                                        at += fine_plane
                                    continue
                                start = levels[here, 2]
                                lost += weight * bilinear(
                                    unusable_coarser, view, start + at, aside, down, p, q
                                )
                                at += channels * start
                                for channel in range(channels):
                                    value = weight * bilinear(coarser, view, at, aside, down, p, q)
                                    found[channel] = value if step == 0 else found[channel] + value
                                    at += tall * wide
                            mean = np.float32(0)
                            for channel in range(channels):
                                mean += found[channel]
                            usable = bool(lost < np.float32(25.5)) and bool(
                                mean > channels * dark_level
                            )
                    valid[patch, view, row, column] = usable
                    for channel in range(channels):
                        radiance[patch, view, channel, row, column] = (
                            found[channel] if usable else np.float32(0)
                        )


@compiled(
    "int64(boolean[:,:,:,::1], int64[::1], int64[::1], boolean[:,:,:,::1])",
)
def sites(valid: Array, rows: Array, columns: Array, asked: Array) -> int:
    """Mark the sites of occlusion tests that have a valid sample, and count them.

    Args:
        valid: Of every patch, view and sample.
        rows: Which row of sites answers for a row of samples.
        columns: Likewise.
        asked: False throughout; filled.
    """
    count = 0
    patches, views, height, width = valid.shape
    for patch in range(patches):
        for view in range(views):
            for row in range(height):
                for column in range(width):
                    if valid[patch, view, row, column]:
                        site = asked[patch, view, rows[row]]
                        if not site[columns[column]]:
                            site[columns[column]] = True
                            count += 1
    return count


@compiled(
    "void(boolean[:,:,:,::1], float64[:,:,:,::1], float64[:,::1], float64[::1],"
    "float32[:,::1], float32[:,::1], float32[::1])"
)
def sight_lines(
    asked: Array,
    points: Array,
    centers: Array,
    tolerance: Array,
    starts: Array,
    directions: Array,
    reach: Array,
) -> None:
    """List the rays from cameras to just before the sites that are asked for.

    Args:
        asked: Of every patch, view and site.
        points: Of every patch and site, world.
        centers: Of the cameras, world.
        tolerance: How far before the point of a patch's site a ray ends.
        starts: Filled.
        directions: Unit; filled.
        reach: Filled.
    """
    ray = 0
    patches, views, height, width = asked.shape
    for patch in range(patches):
        for view in range(views):
            for row in range(height):
                for column in range(width):
                    if asked[patch, view, row, column]:
                        square = 0.0
                        for axis in range(3):
                            step = points[patch, row, column, axis] - centers[view, axis]
                            square += step * step
                            starts[ray, axis] = centers[view, axis]
                        length = math.sqrt(square)
                        for axis in range(3):
                            step = points[patch, row, column, axis] - centers[view, axis]
                            directions[ray, axis] = step / length
                        reach[ray] = max(0.0, length - tolerance[patch])
                        ray += 1


@compiled(
    "void(boolean[:,:,:,::1], boolean[::1], int64[::1], int64[::1],"
    "float32[:,:,:,:,::1], boolean[:,:,:,::1])"
)
def hide(
    asked: Array, blocked: Array, rows: Array, columns: Array, radiance: Array, valid: Array
) -> None:
    """Take away the samples whose site is hidden.

    Args:
        asked: As :func:`sites` filled it; where a ray was blocked it stays true, else not.
        blocked: Of every ray, in their order.
        rows: As :func:`sites` takes it.
        columns: Likewise.
        radiance: Zero where hidden.
        valid: False where hidden.
    """
    ray = 0
    patches, views, channels, height, width = radiance.shape
    for patch in range(patches):
        for view in range(views):
            some = False
            hidden = asked[patch, view]
            for row in range(hidden.shape[0]):
                for column in range(hidden.shape[1]):
                    if hidden[row, column]:
                        hidden[row, column] = blocked[ray]
                        some = some or blocked[ray]
                        ray += 1
            if not some:
                continue
            for row in range(height):
                for column in range(width):
                    if hidden[rows[row], columns[column]]:
                        valid[patch, view, row, column] = False
                        for channel in range(channels):
                            radiance[patch, view, channel, row, column] = 0
