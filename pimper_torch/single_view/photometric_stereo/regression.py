r"""Regression of each pixel's radiance on known lights, by plain or robust least squares.

A pixel's radiance under lights ``l`` is :math:`x_v = l_v^\top b`; the rows of the lights may
be directions, harmonics, or the left factor of a factorization, which is defined up to an
invertible matrix.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.photometry.quadratics import PackedCholesky, outer, unpacked
from pimper_torch.photometry.robust import CAUCHY_TUNING, cauchy_weights, robust_deviation
from pimper_torch.records import Record

# The scale of the weights starts at this multiple and is multiplied by the second per iteration,
# down to 1: choices, so that the initial fit does not decide which samples are outliers.
_WIDEST, _NARROWING = 4.0, 0.7
# Minimum scale, as a fraction of the brightness: a choice, far below the 4e-3 of 8-bit steps.
_MIN_SCALE = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Regressed(Record):
    """The result of a regression.

    Attributes:
        shading: ``b`` of every pixel; zero without samples.
        weight: Final weight of each sample; 0 where it lies in shadow.
    """

    shading: Float[Tensor, "unknown pixel"]
    weight: Float[Tensor, "view pixel"]


def regress(
    radiance: Float[Tensor, "view pixel"],
    weight: Float[Tensor, "view pixel"],
    lights: Float[Tensor, "view unknown"],
    *,
    robust: bool = True,
    iterations: int = 15,
) -> Regressed:
    r"""Fit each pixel's shading vector to its radiance.

    Plain: :math:`\min_b \sum_v w_v (x_v - l_v^\top b)^2`. Robust: the same with Cauchy's
    weights, whose scale is 2.385 robust deviations of the residuals of all pixels; a view whose
    light comes from behind (:math:`l_v^\top b \le 0`) has weight 0. The
    initial fit weights samples by their brightness, up to the pixel's median: shadows are dark.

    Args:
        radiance: Linear, gray. Samples without weight are ignored.
        weight: Not negative; 0 where missing.

    Returns:
        In float64. An underdetermined pixel has one of its minima; see :func:`determined`.
        Constant to autograd.

    Source: Holland & Welsch 1977 for the weights; robust weights in place of thresholds on
    shadows and highlights are common practice since Ikehata et al., CVPR 2012.
    """
    with torch.no_grad():
        seen = weight > 0
        x = torch.where(seen, radiance, 0).double()
        given = weight.double()
        rows = lights.double()
        if not robust:
            return _fit(x, given, rows)
        found = _fit(x, given * brightness(x, seen), rows)
        for iteration in range(iterations):
            widen = max(1.0, _WIDEST * _NARROWING**iteration)
            reliability, lit = reweigh(x, given, rows @ found.shading, widen)
            found = _fit(x, reliability * lit, rows)
        return found


def reweigh(
    radiance: Float[Tensor, "view pixel"],
    weight: Float[Tensor, "view pixel"],
    predicted: Float[Tensor, "view pixel"],
    widen: float,
) -> tuple[Float[Tensor, "view pixel"], Bool[Tensor, "view pixel"]]:
    """Update the samples' weights by their residuals.

    Args:
        predicted: By a fit; below zero for lights from behind.
        widen: Multiple of the scale.

    Returns:
        The weights, and whether a light comes from the front.
    """
    lit = predicted > 0
    residual = torch.where(lit, radiance - predicted, radiance)
    seen = (weight > 0) & lit
    level = radiance[seen].abs().mean() if seen.any() else radiance.new_ones(())
    scale = CAUCHY_TUNING * robust_deviation(residual.flatten(), seen.flatten())
    return weight * cauchy_weights(residual, widen * scale.maximum(_MIN_SCALE * level)), lit


def brightness(
    radiance: Float[Tensor, "view pixel"], seen: Bool[Tensor, "view pixel"]
) -> Float[Tensor, "view pixel"]:
    """Return weights proportional to brightness, up to the median of the pixel."""
    x = torch.where(seen, radiance, torch.nan)
    centre = x.nanmedian(dim=0).values.nan_to_num(nan=0.0)
    centre = torch.where(centre > 0, centre, x.nan_to_num(nan=0.0).amax(dim=0))
    fraction = x.nan_to_num(nan=0.0).clamp_min(0) / torch.where(centre > 0, centre, 1)
    return fraction.clamp_max(1)


def determined(
    weight: Float[Tensor, "view pixel"],
    lights: Float[Tensor, "view unknown"],
    least: float = 1e-4,
) -> tuple[Bool[Tensor, " pixel"], Bool[Tensor, " pixel"]]:
    """Find which pixels have as many samples as unknowns, and lights that span them.

    Args:
        lights: The scale of each column does not matter.
        least: Smallest eigenvalue of the normal equations over the largest. Below 1e-4, noise of
            1 % in the images is as large as the solution.

    Returns:
        Enough samples with a tenth of the largest weight or more; lights that span.
    """
    count = (weight > 0.1 * weight.amax(dim=0).clamp_min(1e-300)).sum(dim=0)
    size = lights.double().norm(dim=0)
    basis = lights.double() / torch.where(size > 0, size, 1)
    unknowns = lights.shape[1]
    values = torch.linalg.eigvalsh(unpacked(outer(basis.mT) @ weight.double(), unknowns))
    spanned = values[:, 0] > least * values[:, -1]
    return count >= unknowns, spanned & (values[:, -1] > 0)


def _fit(
    x: Float[Tensor, "view pixel"],
    weight: Float[Tensor, "view pixel"],
    rows: Float[Tensor, "view unknown"],
) -> Regressed:
    """Solve the normal equations."""
    factored = PackedCholesky(outer(rows.mT) @ weight, rows.shape[1])
    return Regressed(shading=factored.solve(rows.mT @ (weight * x)), weight=weight)
