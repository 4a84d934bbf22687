"""Estimation of the level at which a sensor saturates."""

from itertools import pairwise

import torch
from jaxtyping import Int
from torch import Tensor

# A pile-up is a level that at least this many photographs share, with this many pixels each. In
# renderings without noise, a face of uniform brightness has a different level in each photograph.
_PHOTOGRAPHS, PIXELS = 2, 8


def find_saturation(
    counts: Int[Tensor, " level"], photographs: Int[Tensor, " level"]
) -> int | None:
    """Estimate the level at which a sensor saturates from the values in its photographs.

    Saturated pixels pile up at the top: one narrow band has several times as many pixels as the
    bands just below it, in more than one photograph.

    Args:
        counts: Number of pixels of each level in all photographs, one colour.
        photographs: Number of photographs with at least :data:`PIXELS` pixels of the level.

    Returns:
        The level, or ``None`` without a pile-up: nothing is saturated, or too little to be
        detected. A background of one constant level, brighter than all else and blurred at its
        edges, cannot be distinguished from saturation.
    """
    total = int(counts.sum())
    above = counts.flip(0).cumsum(0).flip(0)
    reached = (above > 2e-6 * total).nonzero()  # without hot pixels
    if len(reached) == 0:
        return None
    top = int(reached[-1])
    # Noise added after saturation, as by subtracting a dark frame, spreads a level by less.
    width = max(1, round(0.004 * top))
    edges = [top + 1 - width * band for band in range(10)]
    if edges[-1] < 0:
        return None
    bands = [int(counts[low:high].sum()) for high, low in pairwise(edges)]
    pile, tail = bands[0], torch.tensor(bands[1:])
    shared = int(photographs[edges[1] : edges[0]].max()) >= _PHOTOGRAPHS
    # Without saturation the top band is not above its tail, which falls off or ends abruptly.
    falls_off = int((tail > 0).sum()) >= 4
    if not (shared and falls_off and pile > 4 * int(tail.max())):
        return None
    cumulative = counts[edges[1] : edges[0]].cumsum(0)
    return edges[1] + int((2 * cumulative >= pile).nonzero()[0])
