"""Saturation: where a sensor stops to follow the light."""

from itertools import pairwise

import torch
from jaxtyping import Int
from torch import Tensor

# A pile-up is a level that so many photographs share, with so many pixels each. A face of one
# brightness, in a rendering without noise, has another in each.
_PHOTOGRAPHS, PIXELS = 2, 8


def find_saturation(
    counts: Int[Tensor, " level"], photographs: Int[Tensor, " level"]
) -> int | None:
    """Find the level at which a sensor saturates from the values in its photographs.

    Saturated pixels pile up at the top: one narrow band holds several times as many as any
    just below it, in more than one photograph.

    Args:
        counts: How often each level of the file occurs, all photographs together, one colour.
        photographs: In how many of them it occurs :data:`PIXELS` times or more.

    Returns:
        The level, or ``None`` without a pile-up: nothing is saturated, or too little to
        tell. A background of one constant level, brighter than all else and blurred towards
        it, looks the same and is found too.
    """
    total = int(counts.sum())
    above = counts.flip(0).cumsum(0).flip(0)
    reached = (above > 2e-6 * total).nonzero()  # but hot pixels
    if len(reached) == 0:
        return None
    top = int(reached[-1])
    # Noise after saturation, such as a dark frame's that was subtracted, spreads a level by less.
    width = max(1, round(0.004 * top))
    edges = [top + 1 - width * band for band in range(10)]
    if edges[-1] < 0:
        return None
    bands = [int(counts[low:high].sum()) for high, low in pairwise(edges)]
    pile, tail = bands[0], torch.tensor(bands[1:])
    shared = int(photographs[edges[1] : edges[0]].max()) >= _PHOTOGRAPHS
    # A tail that falls off holds less at its end, one that ends abruptly as much as the top.
    falls_off = int((tail > 0).sum()) >= 4
    if not (shared and falls_off and pile > 4 * int(tail.max())):
        return None
    held = counts[edges[1] : edges[0]].cumsum(0)
    return edges[1] + int((2 * held >= pile).nonzero()[0])
