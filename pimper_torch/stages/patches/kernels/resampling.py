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
# Photograph and unusable pixels, each the finest level and the others; table of levels, and sizes.
Pyramid = tuple[tuple[Array, Array], tuple[Array, Array], Array, Array]
# Pixels right and down, to the next column, then to the next row.
Sides = tuple[float, float, float, float]


@compiled()
def project_samples(m: Array, samples: signatures.Samples, patch: int, pixels: Array) -> None:
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


@compiled()
def footprint(pixels: Array, row: int, column: int) -> Sides:
    """Return the sides of a sample's footprint."""
    above, below = neighbours(row, pixels.shape[0])
    left, right = neighbours(column, pixels.shape[1])
    return (
        pixels[row, right, 0] - pixels[row, left, 0],
        pixels[row, right, 1] - pixels[row, left, 1],
        pixels[below, column, 0] - pixels[above, column, 0],
        pixels[below, column, 1] - pixels[above, column, 1],
    )


@compiled()
def _mark_facing(
    m: Array,
    center: Array,
    samples: signatures.Samples,
    patch: int,
    inside: Array,
    min_facing: float,
    facing_samples: Array,
) -> bool:
    """Mark the samples in front of a camera and facing it; return whether there are any."""
    origin, spacing, depth, outward = samples
    steepest, any_sample = min_facing * min_facing, False
    for row in range(inside.shape[0]):
        y = origin[patch, 1] + spacing[patch] * row
        for column in range(inside.shape[1]):
            facing_samples[row, column] = False
            if not inside[row, column]:
                continue
            x = origin[patch, 0] + spacing[patch] * column
            z = depth[patch, row, column]
            a, b, c = center[0] - x, center[1] - y, center[2] - z
            facing = a * outward[patch, row, column, 0]
            facing += b * outward[patch, row, column, 1]
            facing += c * outward[patch, row, column, 2]
            if facing > 0 and facing * facing > steepest * (a * a + b * b + c * c):
                in_front = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] > 0
                facing_samples[row, column] = in_front
                any_sample = any_sample or in_front
    return any_sample


@compiled()
def _add_level(
    pixels: Array,
    unusable: Array,
    start: int,
    sides: tuple[int, int],
    place: tuple[float, float],
    weight: Any,  # noqa: ANN401 - numbers of numpy
    blended: Array,
) -> float:
    """Add the weighted pixels around a place in a level; return its weighted unusable part.

    Args:
        start: Row of the level's first pixel.
        place: Pixels right and down, from the centre of the top-left pixel.
    """
    tall, wide = sides
    pixel, right, below, across, down = corners(tall, wide, place[0], place[1])
    lost: float = weight * bilinear(unusable, start + pixel, right, below, across, down)
    pixel += len(blended) * start
    for channel in range(len(blended)):
        blended[channel] += weight * bilinear(pixels, pixel, right, below, across, down)
        pixel += tall * wide
    return lost


@compiled()
def _sample_picture(
    pyramid: Pyramid,
    pixels: Array,
    facing_samples: Array,
    size_px: Array,
    dark_level: float,
    radiance: Array,
    valid: Array,
) -> None:
    """Sample a picture where footprints are inside it; bright and usable samples are valid."""
    channels, height, width = radiance.shape
    (finest, coarser), (unusable, unusable_coarser), levels, fractions = pyramid
    blended = np.empty(channels, np.float32)
    for row in range(height):
        for column in range(width):
            usable = False
            if facing_samples[row, column]:
                u, v = pixels[row, column, 0], pixels[row, column, 1]
                du_column, dv_column, du_row, dv_row = footprint(pixels, row, column)
                area = max(1.0, abs(du_column * dv_row - dv_column * du_row))
                margin = 0.5 * math.sqrt(area)
                if margin <= u <= size_px[0] - margin and margin <= v <= size_px[1] - margin:
                    level, blend = blended_level(area, len(levels))
                    lost: Any = np.float32(0)
                    blended[:] = 0
                    for step in range(2 if blend > 0 else 1):
                        weight = blend if step == 1 else np.float32(1) - blend
                        current, start = level + step, levels[level + step, 2]
                        sides = levels[current, 0], levels[current, 1]
                        place = u * fractions[current, 1] - 0.5, v * fractions[current, 0] - 0.5
                        if current == 0:
                            lost += _add_level(finest, unusable, 0, sides, place, weight, blended)
                        else:
                            lost += _add_level(
                                coarser, unusable_coarser, start, sides, place, weight, blended
                            )
                    mean = np.float32(0)
                    for channel in range(channels):
                        mean += blended[channel]
                    usable = bool(lost < np.float32(25.5)) and bool(mean > channels * dark_level)
            valid[row, column] = usable
            for channel in range(channels):
                radiance[channel, row, column] = blended[channel] if usable else np.float32(0)


@compiled(annotated=True)
def resample_views(
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
    patches, views, _, height, width = radiance.shape
    fractions = shrinkage(levels)
    pixels, facing_samples = np.empty((height, width, 2)), np.empty((height, width), np.bool_)
    for patch in range(patches):
        for view in range(views):
            index, picture = patch * views + view, projection.rows[view]
            m, center = projection.image_from_patch[index], projection.centers_patch[index]
            if not _mark_facing(
                m, center, samples, patch, inside[patch], min_facing, facing_samples
            ):
                radiance[patch, view] = 0
                valid[patch, view] = False
                continue
            project_samples(m, samples, patch, pixels)
            image = images.finest[picture], images.coarser[picture]
            masked = unusable.finest[picture], unusable.coarser[picture]
            pyramid, size_px = (image, masked, levels, fractions), sizes_px[view]
            values, usable = radiance[patch, view], valid[patch, view]
            _sample_picture(pyramid, pixels, facing_samples, size_px, dark_level, values, usable)
