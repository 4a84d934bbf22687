"""Gradients of pictures and geometry: the adjoint of ``ground.kernels.resampling``."""

import math
from typing import NamedTuple

import numpy as np

from pimper_torch.ground.kernels import signatures
from pimper_torch.ground.kernels.compile import compiled
from pimper_torch.ground.kernels.lookup import shrinkage
from pimper_torch.ground.kernels.lookup_adjoint import spread
from pimper_torch.ground.kernels.resampling import neighbours, project


class ViewGradients(NamedTuple):
    """Derivatives by pictures, and by what :class:`Projection` and :class:`Samples` hold."""

    finest: signatures.Floats2
    coarser: signatures.Floats2
    image_from_patch: signatures.Doubles3
    origin: signatures.Doubles2
    spacing: signatures.Doubles1
    depth: signatures.Doubles3


@compiled(annotated=True)
def pull_back(
    images: signatures.PictureRows,
    levels: signatures.Integers2,
    projection: signatures.Projection,
    samples: signatures.Samples,
    valid: signatures.Masks4,
    on_radiance: signatures.Floats5,
    on_pixels: int,
    found: ViewGradients,
) -> None:
    """Compute derivatives by pictures and geometry from those by the samples.

    Args:
        valid: Samples that count, as ``register`` of :mod:`pimper_torch.ground.kernels.resampling`
            finds them.
        on_pixels: Whether derivatives by pictures are wanted, 1 or 0.
        found: Added to.
    """
    rows, image_from_patch, _ = projection
    origin, spacing, depth, _ = samples
    patches, views, channels, height, width = on_radiance.shape
    fractions = shrinkage(levels)
    pixels, drawn = np.empty((height, width, 2)), np.empty((height, width, 2))
    on_channels = np.empty(channels, np.float32)
    for patch in range(patches):
        for view in range(views):
            m = image_from_patch[patch * views + view]
            by_m = found.image_from_patch[patch * views + view]
            if not np.any(valid[patch, view]):
                continue
            project(m, samples, patch, pixels)
            drawn[:] = 0
            for row in range(height):
                above, below = neighbours(row, height)
                for column in range(width):
                    if not valid[patch, view, row, column]:
                        continue
                    left, right = neighbours(column, width)
                    du_column = pixels[row, right, 0] - pixels[row, left, 0]
                    dv_column = pixels[row, right, 1] - pixels[row, left, 1]
                    du_row = pixels[below, column, 0] - pixels[above, column, 0]
                    dv_row = pixels[below, column, 1] - pixels[above, column, 1]
                    signed = du_column * dv_row - dv_column * du_row
                    area = max(1.0, abs(signed))
                    for channel in range(channels):
                        on_channels[channel] = on_radiance[patch, view, channel, row, column]
                    on_u, on_v, on_level = spread(
                        images.finest,
                        images.coarser,
                        found.finest,
                        found.coarser,
                        levels,
                        fractions,
                        rows[view],
                        pixels[row, column, 0],
                        pixels[row, column, 1],
                        area,
                        on_channels,
                        on_pixels > 0,
                    )
                    drawn[row, column, 0] += on_u
                    drawn[row, column, 1] += on_v
                    on_area = on_level / (2 * math.log(2) * math.copysign(area, signed))
                    drawn[row, right, 0] += on_area * dv_row
                    drawn[row, left, 0] -= on_area * dv_row
                    drawn[row, right, 1] -= on_area * du_row
                    drawn[row, left, 1] += on_area * du_row
                    drawn[below, column, 0] -= on_area * dv_column
                    drawn[above, column, 0] += on_area * dv_column
                    drawn[below, column, 1] += on_area * du_column
                    drawn[above, column, 1] -= on_area * du_column
            for row in range(height):
                y = origin[patch, 1] + spacing[patch] * row
                for column in range(width):
                    on_u, on_v = drawn[row, column, 0], drawn[row, column, 1]
                    if on_u == 0 and on_v == 0:
                        continue
                    x = origin[patch, 0] + spacing[patch] * column
                    z = depth[patch, row, column]
                    z_cam = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                    if z_cam == 0:
                        continue  # no place in the picture
                    a, b = on_u / z_cam, on_v / z_cam
                    c = -(a * pixels[row, column, 0] + b * pixels[row, column, 1])
                    by_x = a * m[0, 0] + b * m[1, 0] + c * m[2, 0]
                    by_y = a * m[0, 1] + b * m[1, 1] + c * m[2, 1]
                    found.depth[patch, row, column] += a * m[0, 2] + b * m[1, 2] + c * m[2, 2]
                    found.origin[patch, 0] += by_x
                    found.origin[patch, 1] += by_y
                    found.spacing[patch] += by_x * column + by_y * row
                    for i in range(3):
                        part = a if i == 0 else b if i == 1 else c
                        by_m[i, 0] += part * x
                        by_m[i, 1] += part * y
                        by_m[i, 2] += part * z
                        by_m[i, 3] += part
