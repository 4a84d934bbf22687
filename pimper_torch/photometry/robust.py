"""Robust losses, and robust estimates of scale."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.config import require

# Cauchy's weights are 95 % efficient on Gaussian noise with a scale of so many standard deviations.
CAUCHY_TUNING = 2.385

# The scale of Gaussian noise of unit deviation: the root of the expectation of its equation.
_OF_GAUSSIAN = 0.6472404

# Newton's steps at most, each at most so long: they halve a scale that outliers made too large.
_SCALE_STEPS, _LONGEST_GAIN = 40, 1.5


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

    scale: float = CAUCHY_TUNING

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


def median_spread(
    residual: Float[Tensor, "*batch item"], seen: Bool[Tensor, "*batch item"]
) -> Float[Tensor, "*batch"]:
    """Estimate the standard deviation of residuals from their median size; 0 if none is seen.

    1.4826 makes the median absolute value of Gaussian noise its standard deviation. Where most
    residuals are next to nothing it lets the others go more firmly than :func:`spread`.
    """
    size = torch.where(seen, residual.abs(), torch.nan)
    return 1.4826 * size.nanmedian(dim=-1).values.nan_to_num(nan=0.0)


def spread(
    residual: Float[Tensor, "*batch item"], seen: Bool[Tensor, "*batch item"]
) -> Float[Tensor, "*batch"]:
    r"""Estimate the standard deviation of residuals, robustly and differentiably.

    An M-estimate of scale, of which the median absolute value is the limit of high powers: the
    ``t`` with

    .. math:: \frac1n \sum_i \frac{r_i^4}{r_i^4 + t^4} = \frac12.

    Like the median it bears outliers up to a half of the residuals, and it is as quick to find;
    unlike the median it changes smoothly with every residual, so that its derivative tells how it
    goes on.

    Args:
        residual: Anything where not seen.
        seen: Which count.

    Returns:
        0 where none is seen, or half of them are zero. Differentiable by the implicit function.

    >>> noise = torch.randn(100_000, generator=torch.Generator().manual_seed(0))
    >>> torch.allclose(spread(3 * noise, noise < 9), torch.tensor(3.0), rtol=0.01)
    True

    Source: Huber, Robust Statistics, 1981, chapter 5, for M-estimates of scale.
    """
    variance = robust_variance(torch.where(seen, residual, 0).square(), seen)
    some = variance > 0
    return torch.where(some, torch.where(some, variance, 1).sqrt(), 0)


def robust_variance(
    square: Float[Tensor, "*batch item"], seen: Bool[Tensor, "*batch item"]
) -> Float[Tensor, "*batch"]:
    """Estimate the variance that squared residuals show; see :func:`spread`.

    Args:
        square: Zero where not seen.
        seen: Which count.
    """
    half = seen.sum(dim=-1).to(square) / 2
    some = (square.detach() > 0).sum(dim=-1) > half
    scale = _scale_of_squares(square.detach(), torch.where(some, half, 1))[..., None]
    fraction = _soft_step(square, scale)
    slope = 2 * (fraction * (1 - fraction)).detach().sum(dim=-1)
    off = (fraction.sum(dim=-1) - half) / torch.where(slope > 0, slope, 1)
    # One more of Newton's steps, next to nothing: the derivative is the implicit function's.
    variance = (scale[..., 0] * (1 + off)).clamp_min(0)
    return torch.where(some, variance / _OF_GAUSSIAN**2, 0)


@torch.no_grad()
def _scale_of_squares(
    square: Float[Tensor, "*batch item"], half: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Find the squared scale by Newton's method for its logarithm, from the mean square down."""
    scale = square.mean(dim=-1)
    scale = torch.where(scale > 0, scale, 1)
    close = torch.finfo(square.dtype).eps ** 0.75
    for _ in range(_SCALE_STEPS):
        fraction = _soft_step(square, scale[..., None])
        slope = 2 * (fraction.sum(dim=-1) - fraction.square().sum(dim=-1))
        gain = (fraction.sum(dim=-1) - half) / slope.clamp_min(torch.finfo(slope.dtype).eps)
        scale = scale * gain.clamp(-_LONGEST_GAIN, _LONGEST_GAIN).exp()
        if bool((gain.abs() < close).all()):
            break
    return scale


def _soft_step(
    square: Float[Tensor, "*batch item"], scale: Float[Tensor, "*batch one"]
) -> Float[Tensor, "*batch item"]:
    ratio = (square / scale).clamp_max(1e9).square()
    return ratio / (1 + ratio)


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
