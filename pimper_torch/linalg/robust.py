"""Robust losses, and robust estimates of scale."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.kernels import twin_constants
from pimper_torch.kernels.twin_constants import CAUCHY_TUNING as CAUCHY_TUNING
from pimper_torch.linalg.sums import along_last
from pimper_torch.records.shapes import Scalars
from pimper_torch.runtime.config import Range, require_ranges

Items = Float[Tensor, "*batch item"]
Seen = Bool[Tensor, "*batch item"]
Scale = Annotated[float, Range(above=0, most=1e12)]


class Loss(ABC):
    r"""A loss of residuals, :math:`\tfrac{s^2}{2} \rho(r^2 / s^2)`, which reduces outliers' weight.

    A custom loss defines :meth:`weight`.

    Attributes:
        scale: ``s`` in standard deviations of the residuals.
        code: Number of the loss in compiled kernels; if ``None``, solvers run in torch.
    """

    scale: float
    code: ClassVar[int | None] = None

    def __post_init__(self) -> None:
        require_ranges(self)

    @abstractmethod
    def weight(self, square: Scalars) -> Scalars:
        r"""Return :math:`\rho'(u)` of ``u``, a square over :math:`s^2`: the residual's weight."""

    def slope(self, square: Scalars) -> Scalars:
        """Return the derivative of :meth:`weight`, by autograd."""
        return with_slope(self.weight, square)[1]

    def weights(self, residual: Scalars, deviation: Float[Tensor, "*#batch"]) -> Scalars:
        """Return the weight of each residual, and that of a zero residual if the deviation is 0."""
        return self.weight(_relative_square(residual, self.scale * deviation))

    def curvatures(self, residual: Scalars, deviation: Float[Tensor, "*#batch"]) -> Scalars:
        """Return the second derivative of the loss by the residual; it may be negative."""
        square = _relative_square(residual, self.scale * deviation)
        return self.weight(square) + 2 * square * self.slope(square)


@dataclass(frozen=True, slots=True)
class Squares(Loss):
    r"""Plain least squares, :math:`\rho = u`."""

    code: ClassVar[int | None] = twin_constants.SQUARES
    scale: Scale = 1.0

    def weight(self, square: Scalars) -> Scalars:
        """Return 1."""
        return torch.ones_like(square)


@dataclass(frozen=True, slots=True)
class Cauchy(Loss):
    r"""Cauchy's loss, :math:`\rho = \log(1 + u)`: outliers keep a small influence.

    Source: Holland & Welsch, Communications in Statistics 6(9), 1977.
    """

    code: ClassVar[int | None] = twin_constants.CAUCHY
    scale: Scale = CAUCHY_TUNING

    def weight(self, square: Scalars) -> Scalars:
        r"""Return :math:`1 / (1 + u)`."""
        return 1 / (1 + square)


@dataclass(frozen=True, slots=True)
class GemanMcClure(Loss):
    r"""Geman and McClure's loss, :math:`\rho = u / (1 + u)`: outliers lose all influence.

    Source: Geman & McClure, Bulletin of the International Statistical Institute 52(4), 1987.
    """

    code: ClassVar[int | None] = twin_constants.GEMAN_MCCLURE
    scale: Scale = twin_constants.GEMAN_MCCLURE_TUNING

    def weight(self, square: Scalars) -> Scalars:
        r"""Return :math:`1 / (1 + u)^2`."""
        return 1 / (1 + square).square()


@dataclass(frozen=True, slots=True)
class Huber(Loss):
    r"""Huber's loss, :math:`\rho = u` up to 1 and :math:`2 \sqrt u - 1` beyond: convex.

    Source: Huber, Annals of Mathematical Statistics 35(1), 1964.
    """

    code: ClassVar[int | None] = twin_constants.HUBER
    scale: Scale = twin_constants.HUBER_TUNING

    def weight(self, square: Scalars) -> Scalars:
        r"""Return 1 for :math:`u` up to 1, and :math:`1 / \sqrt u` beyond."""
        return square.clamp_min(1).rsqrt()


def with_slope(
    function: Callable[[Scalars], Float[Tensor, "..."]], at: Scalars
) -> tuple[Float[Tensor, "..."], Scalars]:
    """Return a function's values and the derivative of their sum, both without gradients."""
    with torch.enable_grad():
        at = at.detach().requires_grad_()
        values = function(at)
        if not values.requires_grad:
            return values, torch.zeros_like(at)
        (slope,) = torch.autograd.grad(values.sum(), at)
    return values.detach(), slope


def median_deviation(residual: Items, seen: Seen) -> Scalars:
    """Estimate the standard deviation of residuals by their median absolute value; 0 without any.

    The factor 1.4826 makes it consistent for Gaussian noise. If most residuals are close to zero it
    rejects the others more strictly than :func:`robust_deviation`.
    """
    size = torch.where(seen, residual.abs(), torch.nan)
    return 1.4826 * size.nanmedian(dim=-1).values.nan_to_num(nan=0.0)


def robust_deviation(residual: Items, seen: Seen) -> Scalars:
    r"""Estimate the standard deviation of residuals, robustly and differentiably.

    An M-estimate of scale, the ``t`` with

    .. math:: \frac1n \sum_i \frac{r_i^4}{r_i^4 + t^4} = \frac12.

    With higher powers it tends to the median absolute value. It has the same breakdown point, a
    half, but is a smooth function of every residual.

    Args:
        residual: Ignored where missing.
        seen: False where missing.

    Returns:
        0 if all are missing or half are zero. Differentiable by the implicit function theorem.

    >>> noise = torch.randn(100_000, generator=torch.Generator().manual_seed(0))
    >>> torch.allclose(robust_deviation(3 * noise, noise < 9), torch.tensor(3.0), rtol=0.01)
    True

    Source: Huber, Robust Statistics, 1981, chapter 5, for M-estimates of scale.
    """
    variance = robust_variance(torch.where(seen, residual, 0).square(), seen)
    positive = variance > 0
    return torch.where(positive, torch.where(positive, variance, 1).sqrt(), 0)


def robust_variance(square: Items, seen: Seen) -> Scalars:
    """Estimate the variance from squared residuals; see :func:`robust_deviation`.

    Args:
        square: Zero where missing.
        seen: False where missing.
    """
    half = seen.sum(dim=-1).to(square) / 2
    determined = (square.detach() > 0).sum(dim=-1) > half
    scale = _scale_of_squares(square.detach(), torch.where(determined, half, 1))[..., None]
    fraction = _fractions(square, scale)
    slope = 2 * along_last((fraction * (1 - fraction)).detach())
    correction = (along_last(fraction) - half) / torch.where(slope > 0, slope, 1)
    # The derivative of one more Newton step, of about zero, is that of the implicit function.
    variance = (scale[..., 0] * (1 + correction)).clamp_min(0)
    return torch.where(determined, variance / twin_constants.GAUSSIAN_SCALE**2, 0)


@torch.no_grad()
def _scale_of_squares(square: Items, half: Scalars) -> Scalars:
    """Return the squared scale, by Newton's method for its logarithm from the mean square."""
    scale = along_last(square) / square.shape[-1]
    scale = torch.where(scale > 0, scale, 1)
    tolerance = torch.finfo(square.dtype).eps ** 0.75
    for _ in range(twin_constants.NEWTON_STEPS):
        fraction = _fractions(square, scale[..., None])
        slope = 2 * (along_last(fraction) - along_last(fraction.square()))
        step = (along_last(fraction) - half) / slope.clamp_min(torch.finfo(slope.dtype).eps)
        longest = twin_constants.LONGEST_NEWTON_STEP
        scale = scale * step.clamp(-longest, longest).exp()
        if bool((step.abs() < tolerance).all()):
            break
    return scale


def _fractions(square: Items, scale: Float[Tensor, "*batch one"]) -> Items:
    ratio = (square / scale).clamp_max(1e9).square()
    return ratio / (1 + ratio)


def _relative_square(residual: Scalars, scale: Float[Tensor, "*#batch"]) -> Scalars:
    """Return squared residuals in units of the squared scale; 0 where the scale is 0."""
    relative = torch.where(scale > 0, residual / torch.where(scale > 0, scale, 1), 0)
    return relative * relative


# Weights ``1 / (1 + (r / scale)^2)`` of residuals ``r``; 1 where the scale is 0.
cauchy_weights = Cauchy(scale=1.0).weights
