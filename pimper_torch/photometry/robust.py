"""Robust losses, and robust estimates of scale."""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.config import Range, require_ranges
from pimper_torch.kernels.twin_constants import CAUCHY_TUNING as CAUCHY_TUNING
from pimper_torch.kernels.twin_constants import (
    GAUSSIAN_SCALE,
    LONGEST_NEWTON_STEP,
    NEWTON_STEPS,
)
from pimper_torch.linalg.sums import along_last


@dataclass(frozen=True, slots=True)
class Squares:
    """Plain least squares."""

    def weights(
        self, residual: Float[Tensor, "*batch"], deviation: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch"]:
        """Return weights for iteratively reweighted least squares: 1."""
        return torch.ones_like(residual)

    def curvatures(
        self, residual: Float[Tensor, "*batch"], deviation: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch"]:
        """Return the second derivative of the loss."""
        return torch.ones_like(residual)


@dataclass(frozen=True, slots=True)
class Cauchy:
    r"""Cauchy's loss :math:`\tfrac{s^2}{2} \log(1 + (r / s)^2)`: outliers keep a small influence.

    Attributes:
        scale: ``s`` in standard deviations of the residuals.
    """

    scale: Annotated[float, Range(above=0, most=1e12)] = CAUCHY_TUNING

    def __post_init__(self) -> None:
        require_ranges(self)

    def weights(
        self, residual: Float[Tensor, "*batch"], deviation: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch"]:
        """Return weights for iteratively reweighted least squares; 1 for a zero residual."""
        return cauchy_weights(residual, self.scale * deviation)

    def curvatures(
        self, residual: Float[Tensor, "*batch"], deviation: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch"]:
        """Return the second derivative of the loss, negative for outliers."""
        weight = self.weights(residual, deviation)
        return weight * (2 * weight - 1)


Loss = Squares | Cauchy


def median_deviation(
    residual: Float[Tensor, "*batch item"], seen: Bool[Tensor, "*batch item"]
) -> Float[Tensor, "*batch"]:
    """Estimate residuals' standard deviation by their median absolute value; 0 if none is seen.

    The factor 1.4826 makes it consistent for Gaussian noise. Where most residuals are close to
    zero it rejects the others more strictly than :func:`robust_deviation`.
    """
    size = torch.where(seen, residual.abs(), torch.nan)
    return 1.4826 * size.nanmedian(dim=-1).values.nan_to_num(nan=0.0)


def robust_deviation(
    residual: Float[Tensor, "*batch item"], seen: Bool[Tensor, "*batch item"]
) -> Float[Tensor, "*batch"]:
    r"""Estimate the standard deviation of residuals, robustly and differentiably.

    An M-estimate of scale, of which the median absolute value is the limit of high powers: the
    ``t`` with

    .. math:: \frac1n \sum_i \frac{r_i^4}{r_i^4 + t^4} = \frac12.

    Its breakdown point is a half, like that of the median; unlike the median it is a smooth
    function of every residual.

    Args:
        residual: Ignored where not seen.
        seen: False where missing.

    Returns:
        0 where none is seen, or half of them are zero. Differentiable by the implicit function.

    >>> noise = torch.randn(100_000, generator=torch.Generator().manual_seed(0))
    >>> torch.allclose(robust_deviation(3 * noise, noise < 9), torch.tensor(3.0), rtol=0.01)
    True

    Source: Huber, Robust Statistics, 1981, chapter 5, for M-estimates of scale.
    """
    variance = robust_variance(torch.where(seen, residual, 0).square(), seen)
    positive = variance > 0
    return torch.where(positive, torch.where(positive, variance, 1).sqrt(), 0)


def robust_variance(
    square: Float[Tensor, "*batch item"], seen: Bool[Tensor, "*batch item"]
) -> Float[Tensor, "*batch"]:
    """Estimate the variance from squared residuals; see :func:`robust_deviation`.

    Args:
        square: Zero where not seen.
        seen: False where missing.
    """
    half = seen.sum(dim=-1).to(square) / 2
    determined = (square.detach() > 0).sum(dim=-1) > half
    scale = _scale_of_squares(square.detach(), torch.where(determined, half, 1))[..., None]
    fraction = _fractions(square, scale)
    slope = 2 * along_last((fraction * (1 - fraction)).detach())
    correction = (along_last(fraction) - half) / torch.where(slope > 0, slope, 1)
    # One more Newton step, of length about zero: its derivative is the implicit function's.
    variance = (scale[..., 0] * (1 + correction)).clamp_min(0)
    return torch.where(determined, variance / GAUSSIAN_SCALE**2, 0)


@torch.no_grad()
def _scale_of_squares(
    square: Float[Tensor, "*batch item"], half: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Find the squared scale by Newton's method for its logarithm, from the mean square down."""
    scale = along_last(square) / square.shape[-1]
    scale = torch.where(scale > 0, scale, 1)
    close = torch.finfo(square.dtype).eps ** 0.75
    for _ in range(NEWTON_STEPS):
        fraction = _fractions(square, scale[..., None])
        slope = 2 * (along_last(fraction) - along_last(fraction.square()))
        step = (along_last(fraction) - half) / slope.clamp_min(torch.finfo(slope.dtype).eps)
        scale = scale * step.clamp(-LONGEST_NEWTON_STEP, LONGEST_NEWTON_STEP).exp()
        if bool((step.abs() < close).all()):
            break
    return scale


def _fractions(
    square: Float[Tensor, "*batch item"], scale: Float[Tensor, "*batch one"]
) -> Float[Tensor, "*batch item"]:
    ratio = (square / scale).clamp_max(1e9).square()
    return ratio / (1 + ratio)


def cauchy_weights(
    residual: Float[Tensor, "*batch"], scale: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch"]:
    """Return the weights ``1 / (1 + (r / scale)^2)``; 1 where the scale is 0.

    Iteratively reweighted least squares with them minimizes the sum of
    ``scale^2 / 2 * log(1 + (r / scale)^2)``.

    Source: Holland & Welsch, Communications in Statistics 6(9), 1977.
    """
    relative = torch.where(scale > 0, residual / torch.where(scale > 0, scale, 1), 0)
    return 1 / (1 + relative * relative)
