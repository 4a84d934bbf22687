"""Adjoint of sampling a pyramid: derivatives by its pixels and by the position."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled
from pimper_torch.kernels.lookup import blended_level, corners

Array = NDArray[Any]


@compiled(fast=True)
def pull_back_lookup(
    pictures: tuple[Array, Array],
    on_pictures: tuple[Array, Array],
    levels: Array,
    fractions: Array,
    place: tuple[int, float, float, float],
    on_channels: Array,
    on_pixels: bool,
) -> tuple[float, float, float]:
    """Pull derivatives by a sample's channels back to the pixels that it is interpolated from.

    Args:
        pictures: The finest level of pictures, and the others.
        on_pictures: Added to if ``on_pixels``.
        levels: See :func:`~pimper_torch.stages.patches.kernels.resampling.resample_views`.
        place: Row of the picture; position; area of the footprint, pixels of the finest level.
        on_channels: Derivatives by the sample.

    Returns:
        Derivatives by the position, right and down, and by the level, half the area's log2.
    """
    image, u, v, area = place
    channels, count = len(on_channels), len(levels)
    level, blend = blended_level(area, count)
    on_u, on_v, on_blend = 0.0, 0.0, 0.0
    for step in range(2 if blend > 0 else 1):
        weight = blend if step == 1 else np.float32(1) - blend
        used_level = level + step
        tall, wide = levels[used_level, 0], levels[used_level, 1]
        x, y = u * fractions[used_level, 1] - 0.5, v * fractions[used_level, 0] - 0.5
        index, right, below, across, down = corners(tall, wide, x, y)
        pixels, target, plane = pictures[0], on_pictures[0], tall * wide
        if used_level > 0:
            pixels, target = pictures[1], on_pictures[1]
            index += channels * levels[used_level, 2]
        by_x, by_y = 0.0, 0.0
        for channel in range(channels):
            gradient = on_channels[channel]
            first, second = pixels[image, index], pixels[image, index + right]
            third, fourth = pixels[image, index + below], pixels[image, index + below + right]
            top, bottom = first + across * (second - first), third + across * (fourth - third)
            by_x += gradient * ((second - first) * (1 - down) + (fourth - third) * down)
            by_y += gradient * (bottom - top)
            value = gradient * (top + down * (bottom - top))
            on_blend += value if step == 1 else -value
            if on_pixels:
                gradient *= weight
                target[image, index] += gradient * (1 - across) * (1 - down)
                target[image, index + right] += gradient * across * (1 - down)
                target[image, index + below] += gradient * (1 - across) * down
                target[image, index + below + right] += gradient * across * down
            index += plane
        # Beyond the outermost pixel centres the value does not depend on the position.
        if 0 < x < wide - 1:
            on_u += weight * fractions[used_level, 1] * by_x
        if 0 < y < tall - 1:
            on_v += weight * fractions[used_level, 0] * by_y
    return on_u, on_v, on_blend if blend > 0 else 0.0
