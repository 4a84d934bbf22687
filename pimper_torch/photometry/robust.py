"""Losses that make a least-squares fit indifferent to outliers."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.config import require


@dataclass(frozen=True, slots=True)
class Squares:
    """Plain least squares: every residual counts by its square."""

    def weights(
        self, residual: Float[Tensor, "*batch"], deviation: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch"]:
        """Weigh all residuals by 1."""
        return torch.ones_like(residual)

    def curvatures(
        self, residual: Float[Tensor, "*batch"], deviation: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch"]:
        """Give the second derivative of the loss."""
        return torch.ones_like(residual)


@dataclass(frozen=True, slots=True)
class Cauchy:
    r"""Cauchy's loss :math:`\tfrac{s^2}{2} \log(1 + (r / s)^2)`: outliers still pull a little.

    Attributes:
        scale: ``s`` in standard deviations of the residuals.
    """

    scale: float = 2.385  # 95 % efficient on Gaussian noise

    def __post_init__(self) -> None:
        require(self.scale > 0, "scale", self.scale, "above 0")

    def weights(
        self, residual: Float[Tensor, "*batch"], deviation: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch"]:
        """Weigh residuals for iterated least squares, by 1 at 0."""
        return cauchy_weights(residual, self.scale * deviation)

    def curvatures(
        self, residual: Float[Tensor, "*batch"], deviation: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch"]:
        """Give the second derivative of the loss, negative for outliers."""
        weight = self.weights(residual, deviation)
        return weight * (2 * weight - 1)


Loss = Squares | Cauchy


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
