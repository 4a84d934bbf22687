"""Weights that make a least-squares fit indifferent to outliers."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def spread(
    residual: Float[Tensor, "*batch item"], seen: Bool[Tensor, "*batch item"]
) -> Float[Tensor, "*batch"]:
    """Estimate the standard deviation of residuals from their median size; 0 if none is seen.

    1.4826 makes the median absolute value of Gaussian noise its standard deviation.
    """
    size = torch.where(seen, residual.abs(), torch.nan)
    return 1.4826 * size.nanmedian(dim=-1).values.nan_to_num(nan=0.0)


def cauchy_weights(
    residual: Float[Tensor, "*batch"], scale: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch"]:
    """Weigh residuals by ``1 / (1 + (r / scale)^2)``; where the scale is 0, all by 1.

    Iterating least squares with these weights minimises the sum of
    ``scale^2 / 2 * log(1 + (r / scale)^2)``.

    Source: Holland & Welsch, Communications in Statistics 6(9), 1977.
    """
    relative = torch.where(scale > 0, residual / torch.where(scale > 0, scale, 1), 0)
    return 1 / (1 + relative * relative)
