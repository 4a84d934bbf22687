"""Averages over small windows that stop at the edges of a patch."""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d, pad


def window_mean(
    values: Float[Tensor, "patch channel height width"],
    weight: Float[Tensor, "patch height width"],
    radius: float,
) -> Float[Tensor, "patch channel height width"]:
    """Average with a Gaussian of standard deviation ``radius``, in samples.

    Args:
        values: Anything; what has no weight does not matter, if finite.
        weight: Of each sample, 0 for those that must stay out.
        radius: Cut off at two and a half of it.

    Zero where no sample of the window has weight. Differentiable.
    """
    reach = max(1, round(2.5 * radius))
    steps = torch.arange(-reach, reach + 1, device=values.device, dtype=values.dtype)
    kernel = torch.exp(-0.5 * (steps / radius).square())
    kernel = kernel / kernel.sum()
    heavy = torch.cat([values * weight[:, None], weight[:, None]], dim=1)
    count, channels, height, width = heavy.shape
    flat = heavy.reshape(count * channels, 1, height, width)
    blurred: Tensor = _Blurred.apply(flat, kernel)  # type: ignore[no-untyped-call]
    summed = blurred.reshape(count, channels, height, width)
    total = summed[:, -1:]
    some = total > torch.finfo(total.dtype).eps
    return torch.where(some, summed[:, :-1] / torch.where(some, total, 1), 0)


class _Blurred(torch.autograd.Function):
    """Sums over a window that is symmetric: their own adjoint."""

    @staticmethod
    def forward(
        ctx: Any, flat: Float[Tensor, "item 1 height width"], kernel: Float[Tensor, " tap"]
    ) -> Float[Tensor, "item 1 height width"]:
        """Sum along columns, then along rows."""
        ctx.save_for_backward(kernel)
        reach = len(kernel) // 2
        flat = conv2d(flat, kernel.reshape(1, 1, -1, 1), padding=(reach, 0))
        return conv2d(flat, kernel.reshape(1, 1, 1, -1), padding=(0, reach))

    @staticmethod
    def backward(
        ctx: Any, upstream: Float[Tensor, "item 1 height width"]
    ) -> tuple[Float[Tensor, "item 1 height width"], None]:
        """Sum the gradients in the same way."""
        return _Blurred.apply(upstream, *ctx.saved_tensors), None  # type: ignore[no-untyped-call]


def window_size(radius: float) -> float:
    """Return how many samples the window averages: as many as one of equal weights with its noise.

    >>> round(window_size(2.0))
    50
    """
    return 4 * math.pi * radius**2


def level_weight(
    depth: Float[Tensor, "patch height width"],
    swept: Float[Tensor, "patch height width"],
    spacing: Float[Tensor, " patch"],
    max_slope: float = 4.0,
) -> Float[Tensor, "patch height width"]:
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
