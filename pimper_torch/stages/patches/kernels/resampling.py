"""Resampling of all views on a bucket of templates: twin of ``stages.patches.warp``.

Pyramids are rows of pixels (see ``geometry.pyramids``), with a separate array for the finest
level; ``levels`` has the height, width and offset of each.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels import signatures
from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.lookup import bilinear, blended_level, corners, shrinkage

Array = NDArray[Any]


@compiled()
def project(m: Array, samples: signatures.Samples, patch: int, pixels: Array) -> None:
    """Compute the pixels of a template's samples in a view: right and down."""
    origin, spacing, depth, _ = samples
    for row in range(pixels.shape[0]):
        y = origin[patch, 1] + spacing[patch] * row
        for column in range(pixels.shape[1]):
            x = origin[patch, 0] + spacing[patch] * column
            z = depth[patch, row, column]
            z_cam = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            inverse_z = 1 / z_cam if z_cam != 0 else 1.0
            pixels[row, column, 0] = inverse_z * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3])
            pixels[row, column, 1] = inverse_z * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3])


@compiled()
def neighbours(index: int, count: int) -> tuple[int, int]:
    """Return the two neighbouring samples of the forward difference at an index.

    The last difference is repeated; that of a single sample is zero.
    """
    first = max(0, min(index, count - 2))
    return first, min(first + 1, count - 1)


@compiled(annotated=True)
def register(
    images: signatures.PictureRows,
    unusable: signatures.FractionRows,
    levels: signatures.Integers2,
    projection: signatures.Projection,
    samples: signatures.Samples,
    sizes_px: signatures.Integers2,
    inside: signatures.Masks3,
    min_facing: float,
    dark_level: float,
    radiance: signatures.Floats5,
    valid: signatures.Masks4,
) -> None:
    """Resample the views, and mark valid samples, without regard to occlusion.

    Args:
        levels: Height, width and offset in ``coarser`` of each level, in pixels of one channel.
        min_facing: Cosine of the maximum viewing angle.
        dark_level: Mean over the channels below which a sample is invalid.
    """
    rows, image_from_patch, centers_patch = projection
    origin, spacing, depth, outward = samples
    finest, coarser = images
    unusable_finest, unusable_coarser = unusable
    patches, views, channels, height, width = radiance.shape
    fine_plane = levels[0, 0] * levels[0, 1]
    count = len(levels)
    fractions = shrinkage(levels)
    pixels = np.empty((height, width, 2), np.float64)
    visible = np.empty((height, width), np.bool_)
    blended = np.empty(channels, np.float32)
    steepest = min_facing * min_facing
    for patch in range(patches):
        for view in range(views):
            image = rows[view]
            fine, coarse = finest[image], coarser[image]
            fine_unusable, coarse_unusable = unusable_finest[image], unusable_coarser[image]
            m = image_from_patch[patch * views + view]
            center = centers_patch[patch * views + view]
            any_sample = False
            for row in range(height):
                y = origin[patch, 1] + spacing[patch] * row
                for column in range(width):
                    visible[row, column] = False
                    if not inside[patch, row, column]:
                        continue
                    x = origin[patch, 0] + spacing[patch] * column
                    z = depth[patch, row, column]
                    a, b, c = center[0] - x, center[1] - y, center[2] - z
                    facing = a * outward[patch, row, column, 0]
                    facing += b * outward[patch, row, column, 1]
                    facing += c * outward[patch, row, column, 2]
                    if facing > 0 and facing * facing > steepest * (a * a + b * b + c * c):
                        visible[row, column] = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] > 0
                        any_sample = any_sample or visible[row, column]
            if not any_sample:
                radiance[patch, view] = 0
                valid[patch, view] = False
                continue
            project(m, samples, patch, pixels)
            for row in range(height):
                above, below = neighbours(row, height)
                for column in range(width):
                    usable = False
                    if visible[row, column]:
                        u, v = pixels[row, column, 0], pixels[row, column, 1]
                        left, right = neighbours(column, width)
                        du_column = pixels[row, right, 0] - pixels[row, left, 0]
                        dv_column = pixels[row, right, 1] - pixels[row, left, 1]
                        du_row = pixels[below, column, 0] - pixels[above, column, 0]
                        dv_row = pixels[below, column, 1] - pixels[above, column, 1]
                        area = max(1.0, abs(du_column * dv_row - dv_column * du_row))
                        margin = 0.5 * math.sqrt(area)
                        if (
                            margin <= u <= sizes_px[view, 0] - margin
                            and margin <= v <= sizes_px[view, 1] - margin
                        ):
                            level, blend = blended_level(area, count)
                            lost = np.float32(0)
                            for step in range(2 if blend > 0 else 1):
                                weight = blend if step == 1 else np.float32(1) - blend
                                current = level + step
                                tall, wide = levels[current, 0], levels[current, 1]
                                pixel, to_right, to_below, across, down = corners(
                                    tall,
                                    wide,
                                    u * fractions[current, 1] - 0.5,
                                    v * fractions[current, 0] - 0.5,
                                )
                                if current == 0:
                                    lost += weight * bilinear(
                                        fine_unusable, pixel, to_right, to_below, across, down
                                    )
                                    for channel in range(channels):
                                        blended[channel] = weight * bilinear(
                                            fine, pixel, to_right, to_below, across, down
                                        )
                                        pixel += fine_plane
                                    continue
                                start = levels[current, 2]
                                lost += weight * bilinear(
                                    coarse_unusable, start + pixel, to_right, to_below, across, down
                                )
                                pixel += channels * start
                                for channel in range(channels):
                                    value = weight * bilinear(
                                        coarse, pixel, to_right, to_below, across, down
                                    )
                                    blended[channel] = (
                                        value if step == 0 else blended[channel] + value
                                    )
                                    pixel += tall * wide
                            mean = np.float32(0)
                            for channel in range(channels):
                                mean += blended[channel]
                            usable = bool(lost < np.float32(25.5)) and bool(
                                mean > channels * dark_level
                            )
                    valid[patch, view, row, column] = usable
                    for channel in range(channels):
                        radiance[patch, view, channel, row, column] = (
                            blended[channel] if usable else np.float32(0)
                        )
