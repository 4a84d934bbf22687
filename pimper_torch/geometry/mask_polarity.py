"""Evidence of which brightness of masks is the object."""

from collections.abc import Sequence

import torch
from jaxtyping import Shaped
from torch import Tensor

from pimper_torch.runtime.mapped import each

Raster = Shaped[Tensor, "_ _"]


def around_and_inside(maps: Sequence[Raster]) -> tuple[float, float]:
    """Return the fractions of positive pixels along maps' borders and in their middle halves."""
    around, inside = [], []
    for (x,) in each(maps):
        high, wide = x.shape
        around += [side.gt(0).float().mean() for side in (x[0], x[-1], x[:, 0], x[:, -1])]
        middle = x[high // 4 : -(-3 * high // 4), wide // 4 : -(-3 * wide // 4)]
        inside.append(middle.gt(0).float().mean())
    return float(torch.stack(around).mean()), float(torch.stack(inside).mean())
