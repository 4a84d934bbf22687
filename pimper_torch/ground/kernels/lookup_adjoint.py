"""The adjoint of a look-up in a pyramid: derivatives by its pixels and by the place."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pimper_torch.ground.kernels.compile import compiled
from pimper_torch.ground.kernels.lookup import blended_level, corners

Array = NDArray[Any]


@compiled(fast=True)
def spread(
    finest: Array,
    coarser: Array,
    on_finest: Array,
    on_coarser: Array,
    levels: Array,
    fractions: Array,
    image: int,
    u: float,
    v: float,
    area: float,
    on_channels: Array,
    on_pixels: bool,
) -> tuple[float, float, float]:
    """Add what a sample's channels draw to the pixels that they are blended from.

    Args:
        on_finest: Added to, and ``on_coarser``, if ``on_pixels``.
        levels: As :func:`~pimper_torch.ground.kernels.resampling.register` takes them.
        area: Of the sample's footprint, pixels of the finest level.
        on_channels: Derivatives by the sample.

    Returns:
        Derivatives by the place, right and down, and by the level, half the area's logarithm to
        base 2.
    """
    channels, count = len(on_channels), len(levels)
    level, blend = blended_level(area, count)
    on_u, on_v, on_blend = 0.0, 0.0, 0.0
    for step in range(2 if blend > 0 else 1):
        weight = blend if step == 1 else np.float32(1) - blend
        here = level + step
        tall, wide = levels[here, 0], levels[here, 1]
        x, y = u * fractions[here, 1] - 0.5, v * fractions[here, 0] - 0.5
        at, right, below, across, down = corners(tall, wide, x, y)
        pixels, target, plane = finest, on_finest, tall * wide
        if here > 0:
            pixels, target = coarser, on_coarser
            at += channels * levels[here, 2]
        by_x, by_y = 0.0, 0.0
        for channel in range(channels):
            drawn = on_channels[channel]
            first, second = pixels[image, at], pixels[image, at + right]
            third, fourth = pixels[image, at + below], pixels[image, at + below + right]
            top, bottom = first + across * (second - first), third + across * (fourth - third)
            by_x += drawn * ((second - first) * (1 - down) + (fourth - third) * down)
            by_y += drawn * (bottom - top)
            value = drawn * (top + down * (bottom - top))
            on_blend += value if step == 1 else -value
            if on_pixels:
                drawn *= weight
                target[image, at] += drawn * (1 - across) * (1 - down)
                target[image, at + right] += drawn * across * (1 - down)
                target[image, at + below] += drawn * (1 - across) * down
                target[image, at + below + right] += drawn * across * down
            at += plane
        # Beyond the outermost centres the place does not count.
        if 0 < x < wide - 1:
            on_u += weight * fractions[here, 1] * by_x
        if 0 < y < tall - 1:
            on_v += weight * fractions[here, 0] * by_y
    return on_u, on_v, on_blend if blend > 0 else 0.0
