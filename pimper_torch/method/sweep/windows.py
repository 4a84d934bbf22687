"""Averages over small windows that stop at the edges of a patch."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.ground.shapes import PatchRaster

Layers = Float[Tensor, "patch channel height width"]


def window_mean(values: Layers, weight: PatchRaster, radius: float) -> Layers:
    """Average with a Gaussian of standard deviation ``radius``, in samples.

    Args:
        values: Anything; what has no weight does not matter, if finite.
        weight: Of each sample, 0 for those that must stay out.
        radius: Cut off at two and a half of it.

    Zero where no sample of the window has weight. Differentiable.
    """
    heavy = torch.cat([values * weight[:, None], weight[:, None]], dim=1)
    rows, columns = (_blur(size, radius).to(heavy) for size in heavy.shape[2:])
    summed = rows @ (heavy @ columns)
    total = summed[:, -1:]
    some = total > torch.finfo(total.dtype).eps
    return torch.where(some, summed[:, :-1] / torch.where(some, total, 1), 0)


def _blur(size: int, radius: float) -> Float[Tensor, "size size"]:
    """Return the symmetric matrix that sums over the window along an axis of that many samples."""
    reach = max(1, round(2.5 * radius))
    steps = torch.arange(max(size, reach + 1))
    away = (steps[:size, None] - steps[:size]).abs()
    taps = torch.exp(-0.5 * (steps.double() / radius).square()) * (steps <= reach)
    return (taps / (2 * taps.sum() - 1))[away]


def window_size(radius: float) -> float:
    """Return how many samples the window averages: as many as one of equal weights with its noise.

    >>> round(window_size(2.0))
    50
    """
    return 4 * math.pi * radius**2


def level_weight(
    depth: PatchRaster, swept: PatchRaster, spacing: Float[Tensor, " patch"], max_slope: float = 4.0
) -> PatchRaster:
    """Return the weight of every sample in windows: none on a cliff.

    A window would otherwise mix the two sides of a depth edge.

    Args:
        swept: 1 where a sample has costs, else 0.
        spacing: Of the samples, in units of the depth.
        max_slope: Between a sample and each of its four neighbours; more is a cliff.
    """
    per_sample = 1 / spacing[:, None, None]
    across = depth.diff(dim=2).abs() * per_sample < max_slope
    down = depth.diff(dim=1).abs() * per_sample < max_slope
    level = pad(across, (1, 0), value=True) & pad(across, (0, 1), value=True)
    level = level & pad(down, (0, 0, 1, 0), value=True) & pad(down, (0, 0, 0, 1), value=True)
    return swept * level
