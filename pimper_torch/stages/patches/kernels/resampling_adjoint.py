"""Adjoint of ``resampling``: gradients of pictures and geometry."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels import signatures
from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.lookup import shrinkage
from pimper_torch.kernels.lookup_adjoint import pull_back_lookup
from pimper_torch.stages.patches.kernels.resampling import (
    Sides,
    footprint,
    neighbours,
    project_samples,
)

Array = NDArray[Any]


class ViewGradients(NamedTuple):
    """Derivatives by pictures, and by fields of :class:`Projection` and :class:`Samples`."""

    finest: signatures.Floats2
    coarser: signatures.Floats2
    image_from_patch: signatures.Doubles3
    origin: signatures.Doubles2
    spacing: signatures.Doubles1
    depth: signatures.Doubles3


@compiled()
def _pull_back_area(
    sides: Sides, on_area: float, row: int, column: int, on_positions: Array
) -> None:
    """Add derivatives of a footprint's area by the pixels of neighbouring samples."""
    du_column, dv_column, du_row, dv_row = sides
    above, below = neighbours(row, on_positions.shape[0])
    left, right = neighbours(column, on_positions.shape[1])
    on_positions[row, right, 0] += on_area * dv_row
    on_positions[row, left, 0] -= on_area * dv_row
    on_positions[row, right, 1] -= on_area * du_row
    on_positions[row, left, 1] += on_area * du_row
    on_positions[below, column, 0] -= on_area * dv_column
    on_positions[above, column, 0] += on_area * dv_column
    on_positions[below, column, 1] += on_area * du_column
    on_positions[above, column, 1] -= on_area * du_column


@compiled()
def _pull_back_projection(
    m: Array,
    samples: signatures.Samples,
    patch: int,
    pixels: Array,
    on_positions: Array,
    by_m: Array,
    gradients: ViewGradients,
) -> None:
    """Add derivatives of samples' pixels by the projection and the samples."""
    origin, spacing, depth, _ = samples
    for row in range(pixels.shape[0]):
        y = origin[patch, 1] + spacing[patch] * row
        for column in range(pixels.shape[1]):
            on_u, on_v = on_positions[row, column, 0], on_positions[row, column, 1]
            if on_u == 0 and on_v == 0:
                continue
            x = origin[patch, 0] + spacing[patch] * column
            z = depth[patch, row, column]
            z_cam = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            if z_cam == 0:
                continue  # no position in the picture
            a, b = on_u / z_cam, on_v / z_cam
            c = -(a * pixels[row, column, 0] + b * pixels[row, column, 1])
            by_x = a * m[0, 0] + b * m[1, 0] + c * m[2, 0]
            by_y = a * m[0, 1] + b * m[1, 1] + c * m[2, 1]
            gradients.depth[patch, row, column] += a * m[0, 2] + b * m[1, 2] + c * m[2, 2]
            gradients.origin[patch, 0] += by_x
            gradients.origin[patch, 1] += by_y
            gradients.spacing[patch] += by_x * column + by_y * row
            for i in range(3):
                factor = a if i == 0 else b if i == 1 else c
                by_m[i, 0] += factor * x
                by_m[i, 1] += factor * y
                by_m[i, 2] += factor * z
                by_m[i, 3] += factor


@compiled(annotated=True)
def pull_back_resampling(
    images: signatures.PictureRows,
    levels: signatures.Integers2,
    projection: signatures.Projection,
    samples: signatures.Samples,
    valid: signatures.Masks4,
    on_radiance: signatures.Floats5,
    on_pixels: int,
    gradients: ViewGradients,
) -> None:
    """Compute derivatives by pictures and geometry from those by the samples.

    Args:
        valid: Valid samples, from ``resampling.resample_views``.
        on_pixels: Whether derivatives by pictures are needed, 1 or 0.
        gradients: Added to.
    """
    patches, views, channels, height, width = on_radiance.shape
    fractions = shrinkage(levels)
    pixels, on_positions = np.empty((height, width, 2)), np.empty((height, width, 2))
    on_channels, on_images = np.empty(channels, np.float32), (gradients.finest, gradients.coarser)
    for patch in range(patches):
        for view in range(views):
            index = patch * views + view
            m, by_m = projection.image_from_patch[index], gradients.image_from_patch[index]
            if not np.any(valid[patch, view]):
                continue
            project_samples(m, samples, patch, pixels)
            on_positions[:] = 0
            for row in range(height):
                for column in range(width):
                    if not valid[patch, view, row, column]:
                        continue
                    sides = footprint(pixels, row, column)
                    signed = sides[0] * sides[3] - sides[1] * sides[2]
                    area = max(1.0, abs(signed))
                    for channel in range(channels):
                        on_channels[channel] = on_radiance[patch, view, channel, row, column]
                    u, v = pixels[row, column, 0], pixels[row, column, 1]
                    place = projection.rows[view], u, v, area
                    on_u, on_v, on_level = pull_back_lookup(
                        images, on_images, levels, fractions, place, on_channels, on_pixels > 0
                    )
                    on_positions[row, column, 0] += on_u
                    on_positions[row, column, 1] += on_v
                    on_area = on_level / (2 * math.log(2) * math.copysign(area, signed))
                    _pull_back_area(sides, on_area, row, column, on_positions)
            _pull_back_projection(m, samples, patch, pixels, on_positions, by_m, gradients)
