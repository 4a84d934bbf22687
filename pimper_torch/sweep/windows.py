"""Averages over small windows that stop at the edges of a patch."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import conv2d


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
    flat = conv2d(flat, kernel.reshape(1, 1, -1, 1), padding=(reach, 0))
    flat = conv2d(flat, kernel.reshape(1, 1, 1, -1), padding=(0, reach))
    summed = flat.reshape(count, channels, height, width)
    total = summed[:, -1:]
    some = total > torch.finfo(total.dtype).eps
    return torch.where(some, summed[:, :-1] / torch.where(some, total, 1), 0)


def level_weight(
    depth: Float[Tensor, "patch height width"],
    inside: Bool[Tensor, "patch height width"],
    spacing: Float[Tensor, " patch"],
    steepest: float,
) -> Float[Tensor, "patch height width"]:
    """Give 1 inside, falling to 0 where the template's depth runs up a cliff.

    A window would otherwise mix the two sides of a depth edge.
    """
    weight = inside.to(depth)
    for axis in (1, 2):
        slope = depth.diff(dim=axis).abs() / spacing[:, None, None]
        gentle = (slope < steepest).to(depth)
        size = depth.shape[axis]
        weight.narrow(axis, 0, size - 1).mul_(gentle)
        weight.narrow(axis, 1, size - 1).mul_(gentle)
    return weight
