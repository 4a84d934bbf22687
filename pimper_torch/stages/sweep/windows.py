"""Averages over small windows that stop at the edges of a patch."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.records.shapes import PatchRaster

Layers = Float[Tensor, "patch channel height width"]


def window_mean(values: Layers, weight: PatchRaster, radius: float) -> Layers:
    """Return Gaussian averages of standard deviation ``radius``, in samples.

    Args:
        values: Ignored where the weight is 0, but must be finite.
        weight: Of each sample; 0 excludes it.
        radius: The window is cut off at 2.5 times this.

    Zero where no sample of the window has weight. Differentiable.
    """
    weighted = torch.cat([values * weight[:, None], weight[:, None]], dim=1)
    rows, columns = (_blur(size, radius).to(weighted) for size in weighted.shape[2:])
    summed = rows @ (weighted @ columns)
    total = summed[:, -1:]
    positive = total > torch.finfo(total.dtype).eps
    return torch.where(positive, summed[:, :-1] / torch.where(positive, total, 1), 0)


def _blur(size: int, radius: float) -> Float[Tensor, "size size"]:
    """Return the symmetric matrix that averages over the window along an axis of ``size``."""
    reach = max(1, round(2.5 * radius))
    steps = torch.arange(max(size, reach + 1))
    away = (steps[:size, None] - steps[:size]).abs()
    taps = torch.exp(-0.5 * (steps.double() / radius).square()) * (steps <= reach)
    return (taps / (2 * taps.sum() - 1))[away]


def window_size(radius: float) -> float:
    """Return the effective number of samples in the window: equal weights give the same noise.

    >>> round(window_size(2.0))
    50
    """
    return 4 * math.pi * radius**2


def flat_weight(
    depth: PatchRaster, swept: PatchRaster, spacing: Float[Tensor, " patch"], max_slope: float = 4.0
) -> PatchRaster:
    """Return the weight of every sample in windows, 0 on a cliff.

    Otherwise a window would mix the two sides of a depth edge.

    Args:
        swept: 1 where a sample has costs, else 0.
        spacing: Sample spacing, in units of the depth.
        max_slope: Largest slope between a sample and its four neighbours; above it is a cliff.
    """
    per_sample = 1 / spacing[:, None, None]
    across = depth.diff(dim=2).abs() * per_sample < max_slope
    down = depth.diff(dim=1).abs() * per_sample < max_slope
    flat = pad(across, (1, 0), value=True) & pad(across, (0, 1), value=True)
    flat = flat & pad(down, (0, 0, 1, 0), value=True) & pad(down, (0, 0, 0, 1), value=True)
    return swept * flat
