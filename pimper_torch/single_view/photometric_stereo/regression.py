r"""Regression of each pixel's radiance on known lights, by plain or robust least squares.

A pixel's radiance under lights ``l`` is :math:`x_v = l_v^\top b`; the rows of the lights may
be directions, harmonics, or the left factor of a factorization, which is defined up to an
invertible matrix.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.photometry.quadratics import PackedCholesky, diagonal, outer, unpacked
from pimper_torch.photometry.robust import CAUCHY_TUNING, cauchy_weights, robust_deviation
from pimper_torch.records import Record

# The scale of the weights starts at this multiple and is multiplied by the second per iteration,
# down to 1: choices, so that the initial fit does not decide which samples are outliers.
_WIDEST, _NARROWING = 4.0, 0.7
# Minimum scale, as a fraction of the brightness: a choice, far below the 4e-3 of 8-bit steps.
_MIN_SCALE = 1e-4

Shadows = Literal["attached", "none"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Regressed(Record):
    """The result of a regression.

    Attributes:
        shading: ``b`` of every pixel; zero without samples.
        weight: Final weight of each sample; 0 where it lies in shadow.
        base: Radiance besides ``l . b`` that is the same in all views; zero without ``base``.
    """

    shading: Float[Tensor, "unknown pixel"]
    weight: Float[Tensor, "view pixel"]
    base: Float[Tensor, " pixel"]


def regress(
    radiance: Float[Tensor, "view pixel"],
    weight: Float[Tensor, "view pixel"],
    lights: Float[Tensor, "view unknown"],
    *,
    robust: bool = True,
    shadows: Shadows = "attached",
    base: bool = False,
    iterations: int = 15,
) -> Regressed:
    r"""Fit each pixel's shading vector to its radiance.

    Plain: :math:`\min_b \sum_v w_v (x_v - l_v^\top b)^2`. Robust: the same with Cauchy's
    weights, whose scale is 2.385 robust deviations of the residuals of all pixels; with attached
    shadows, a view whose light comes from behind (:math:`l_v^\top b \le 0`) has weight 0. The
    initial fit weights samples by their brightness, up to the pixel's median: shadows are dark.

    Args:
        radiance: Linear, gray. Samples without weight are ignored.
        weight: Not negative; 0 where missing.
        shadows: Of a light from behind: ``attached``, radiance is 0; ``none``, it is linear in
            the light, and negative.
        base: Whether radiance has a part that is the same in all views, such as ambient light.

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
            return _fit(x, given, torch.zeros_like(given), rows, base)
        found = _fit(x, given * brightness(x, seen, base), torch.zeros_like(given), rows, base)
        for iteration in range(iterations):
            direct = rows @ found.shading
            reliability, lit = reweigh(
                x - found.base, given, direct, max(1.0, _WIDEST * _NARROWING**iteration), shadows
            )
            found = _fit(x, reliability * lit, reliability * ~lit, rows, base)
        return found


def reweigh(
    radiance: Float[Tensor, "view pixel"],
    weight: Float[Tensor, "view pixel"],
    predicted: Float[Tensor, "view pixel"],
    widen: float,
    shadows: Shadows,
) -> tuple[Float[Tensor, "view pixel"], Bool[Tensor, "view pixel"]]:
    """Update the samples' weights by their residuals.

    Args:
        radiance: Observed.
        predicted: By a fit; below zero for lights from behind.
        widen: Multiple of the scale.
        shadows: Of lights from behind; see :func:`regress`.

    Returns:
        The weights, and whether a light comes from the front.
    """
    lit = predicted > 0 if shadows == "attached" else torch.ones_like(weight, dtype=torch.bool)
    residual = torch.where(lit, radiance - predicted, radiance)
    seen = (weight > 0) & lit
    level = radiance[seen].abs().mean() if seen.any() else radiance.new_ones(())
    scale = CAUCHY_TUNING * robust_deviation(residual.flatten(), seen.flatten())
    return weight * cauchy_weights(residual, widen * scale.maximum(_MIN_SCALE * level)), lit


def brightness(
    radiance: Float[Tensor, "view pixel"], seen: Bool[Tensor, "view pixel"], base: bool = False
) -> Float[Tensor, "view pixel"]:
    """Return weights proportional to brightness, up to the median of the pixel."""
    x = torch.where(seen, radiance, torch.nan)
    if base:
        x = x - x.nan_to_num(nan=torch.inf).amin(dim=0)
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
        weight: Of the samples, after a regression.
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
    lit: Float[Tensor, "view pixel"],
    dark: Float[Tensor, "view pixel"],
    rows: Float[Tensor, "view unknown"],
    base: bool,
) -> Regressed:
    """Solve the normal equations; samples in shadow constrain the base only."""
    if base:
        rows = torch.cat([rows, torch.ones_like(rows[:, :1])], dim=1)
    packed = outer(rows.mT) @ lit
    rhs = rows.mT @ (lit * x)
    if base:
        packed[diagonal(rows.shape[1])[-1]] += dark.sum(dim=0)
        rhs[-1] += (dark * x).sum(dim=0)
    solution = PackedCholesky(packed, rows.shape[1]).solve(rhs)
    if base:
        return Regressed(shading=solution[:-1], weight=lit, base=solution[-1])
    return Regressed(shading=solution, weight=lit, base=torch.zeros_like(solution[0]))
