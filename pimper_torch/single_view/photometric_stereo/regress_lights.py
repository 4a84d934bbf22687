r"""Regression of each pixel's radiance on known or factorized lights, robust to shadows.

A pixel's radiance under lights ``l`` is :math:`x_v = l_v^\top b`; the rows of the lights may
be directions, harmonics, or the left factor of a factorization :math:`X = L S`, which is defined up
to an invertible matrix. With known lights, :math:`x_{vc} = \rho_c\, l_v^\top n` has one normal for
all colours and an albedo for each.

Source: Woodham, Photometric method for determining surface orientation from multiple images,
Optical Engineering 19(1), 1980.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.linalg.robust import CAUCHY_TUNING, cauchy_weights, robust_deviation
from pimper_torch.records import Record
from pimper_torch.records.shapes import ViewVectors
from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.factorization.low_rank import brightness_guess, low_rank_problem
from pimper_torch.stages.photometry.quadratics import PackedCholesky, outer, unpacked
from pimper_torch.stages.photometry.variable_projection import solve_variable_projection

Samples = Float[Tensor, "view pixel"]
Lights = Float[Tensor, "view unknown"]
Colours = Float[Tensor, "view channel pixel"]
ChannelPixels = Float[Tensor, "channel pixel"]

# The scale of the weights starts at the first multiple and is multiplied by the second value per
# iteration, down to 1, so that the initial fit does not determine the outliers. Chosen by hand.
_WIDEST, _NARROWING = 4.0, 0.7


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Factored(Record):
    """Lights and shading vectors, whose product approximates photographs.

    Attributes:
        lights: ``L``; with orthonormal columns if they are factors of the photographs.
        shading: ``b`` of every pixel; zero without samples.
        weight: Final weight of each sample; 0 where missing or in shadow.
    """

    lights: Lights
    shading: Float[Tensor, "unknown pixel"]
    weight: Samples


def regress(radiance: Samples, weight: Samples, lights: Lights, *, robust: bool = True) -> Factored:
    r"""Return the fit of each pixel's shading vector to its radiance.

    Not robust: :math:`\min_b \sum_v w_v (x_v - l_v^\top b)^2`. Robust: the same with Cauchy's
    weights, whose scale is 2.385 robust deviations of the residuals of all pixels; views with
    light from behind (:math:`l_v^\top b \le 0`) have weight 0. The initial fit weights samples by
    their brightness, up to the pixel's median, because shadows are dark.

    An underdetermined pixel has one of its minima; see :func:`determined`. Float64, no gradient.

    Source: Holland & Welsch 1977 for the weights; robust weights instead of thresholds for shadows
    and highlights are common practice since Ikehata et al., CVPR 2012.
    """
    with torch.no_grad():
        seen = weight > 0
        x = torch.where(seen, radiance, 0).double()
        prior = weight.double()
        rows = lights.double()
        if not robust:
            return _fit(x, prior, rows)
        fit = _fit(x, prior * brightness(x, seen), rows)
        for iteration in range(15):
            widen = max(1.0, _WIDEST * _NARROWING**iteration)
            fit = _fit(x, reweigh(x, prior, rows @ fit.shading, widen), rows)
        return fit


def reweigh(radiance: Samples, weight: Samples, predicted: Samples, widen: float) -> Samples:
    """Return the samples' weights from their residuals; 0 for light from behind.

    Args:
        predicted: Radiance of a fit; negative for light from behind.
        widen: Multiple of the scale.
    """
    lit = predicted > 0
    residual = torch.where(lit, radiance - predicted, radiance)
    seen = (weight > 0) & lit
    mean = radiance[seen].abs().mean().nan_to_num(nan=1.0)
    scale = CAUCHY_TUNING * robust_deviation(residual.flatten(), seen.flatten())
    # The minimum scale is far below the 4e-3 of 8-bit steps.
    return weight * cauchy_weights(residual, widen * scale.maximum(1e-4 * mean)) * lit


def brightness(radiance: Samples, seen: Bool[Tensor, "view pixel"]) -> Samples:
    """Return weights proportional to brightness, up to the median of the pixel."""
    x = torch.where(seen, radiance, torch.nan)
    centre = x.nanmedian(dim=0).values.nan_to_num(nan=0.0)
    centre = torch.where(centre > 0, centre, x.nan_to_num(nan=0.0).amax(dim=0))
    fraction = x.nan_to_num(nan=0.0).clamp_min(0) / torch.where(centre > 0, centre, 1)
    return fraction.clamp_max(1)


def determined(weight: Samples, lights: Lights) -> Bool[Tensor, " pixel"]:
    """Return whether pixels have enough samples, under lights that span the unknowns."""
    count = (weight > 0.1 * weight.amax(dim=0).clamp_min(1e-300)).sum(dim=0)
    basis = normalize(lights.double(), dim=0, eps=1e-300)
    unknowns = lights.shape[1]
    values = torch.linalg.eigvalsh(unpacked(outer(basis.mT) @ weight.double(), unknowns))
    # Below this ratio, noise of 1 % in the images leads to errors as large as the solution.
    spanned = values[:, 0] > 1e-4 * values[:, -1]
    return (count >= unknowns) & spanned & (values[:, -1] > 0)


def _fit(x: Samples, weight: Samples, rows: Lights) -> Factored:
    factored = PackedCholesky(outer(rows.mT) @ weight, rows.shape[1])
    shading = factored.solve(rows.mT @ (weight * x))
    return Factored(lights=rows, shading=shading, weight=weight)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class StereoSolution(Record):
    """Normals, albedo and lights of the pixels inside a mask in raster order, in float64.

    Attributes:
        normals: Unit normals in the frame of the lights; zero for black pixels.
        weight: Final weight of each sample; 0 where missing or in shadow.
    """

    normals: Float[Tensor, "3 pixel"]
    albedo: ChannelPixels
    lights: ViewVectors
    weight: Samples


def calibrated_stereo(
    radiance: Colours, weight: Samples, lights: ViewVectors, *, robust: bool = True
) -> StereoSolution:
    r"""Return normals and albedos of pixels under known distant lights; constant to autograd.

    Weights are those of the mean of the channels; see :func:`regress`. Normal and albedos are the
    least-squares solution over all channels, :math:`n \rho^\top = B v v^\top`: the columns of ``B``
    are the solutions of single channels, and ``v`` is the leading eigenvector of
    :math:`B^\top A B` with :math:`A = \sum w\, l l^\top`.

    Args:
        lights: Direction to the point light times its irradiance.
    """
    with torch.no_grad():
        x = torch.where((weight > 0)[:, None], radiance, 0).double()
        gray = regress(x.mean(dim=1), weight, lights, robust=robust)
        rows = gray.lights
        factored = PackedCholesky(outer(rows.mT) @ gray.weight, 3)
        sides = rows.mT @ (gray.weight[:, None] * x).movedim(1, 0)
        single = torch.stack([factored.solve(side) for side in sides])
        common = torch.einsum("cip,dip->pcd", single, sides)
        albedo = torch.linalg.eigh(common).eigenvectors[..., -1].mT
        albedo = torch.where(albedo.sum(dim=0) < 0, -albedo, albedo)
        shading = (single * albedo[:, None]).sum(dim=0)
        return StereoSolution(
            normals=normalize(shading, dim=0, eps=1e-300),
            albedo=(shading.norm(dim=0) * albedo).clamp_min(0),
            lights=rows,
            weight=gray.weight,
        )


def chromatic_albedo(radiance: Colours, weight: Samples, shade: Samples) -> ChannelPixels:
    """Return the albedo of each channel, not negative, that fits the shading of albedo 1."""
    x = torch.where((weight > 0)[:, None], radiance, 0).to(shade)
    square = (weight * shade * shade).sum(dim=0)
    product = ((weight * shade)[:, None] * x).sum(dim=0)
    return (product / torch.where(square > 0, square, 1)).clamp_min(0)


# Steps of variable projection for the first solution, and after every change of weights, whose
# scale decreases more slowly than in a regression. Chosen by hand.
_FIRST_STEPS, _NEXT_STEPS, _NARROWING_FACTORED = 100, 5, 0.8


def factorize_photographs(
    radiance: Samples, weight: Samples, rank: int, *, robust: bool = True
) -> Factored:
    """Return factors of photographs with missing samples, shadows and highlights.

    For complete photographs without robust weights, by singular value decomposition. Otherwise
    lights are estimated from an even subset of pixels by variable projection, with Cauchy's weights
    if ``robust``, and the shading of all pixels is regressed on them. Constant to autograd.

    Source: Hayakawa, JOSA A 11(11), 1994, for the decomposition.
    """
    with torch.no_grad():
        seen = weight > 0
        x = torch.where(seen, radiance, 0).double()
        prior = weight.double()
        usable = torch.nonzero(seen.sum(dim=0) > rank)[:, 0]
        views = int(seen.any(dim=1).sum())
        if views < rank or len(usable) <= rank:
            raise InputError(
                f"factorization: {views} views have samples, {len(usable)} pixels more than "
                f"{rank}; needed: {rank} views and more than {rank} such pixels. Add photographs "
                "or widen the mask."
            )
        if not robust and bool((prior == prior[seen].max()).all()):
            left = torch.linalg.eigh(x @ x.mT).eigenvectors[:, -rank:].flip(1)
            return Factored(lights=left, shading=left.mT @ x, weight=prior)
        # Lights are estimated from a subset of pixels, shading for all.
        spaced = torch.linspace(0, len(usable) - 1, min(len(usable), 4000)).round().long()
        subset = usable[spaced.to(usable.device)]
        samples, weights = x[:, subset], prior[:, subset]
        if robust:
            weights = weights * brightness(samples, seen[:, subset])
        # Missing samples start as the product of the view's and the pixel's brightness.
        fraction = weights / weights.amax().clamp_min(1e-300)
        filled = fraction * samples + (1 - fraction) * brightness_guess(samples, weights)
        left = torch.linalg.eigh(filled @ filled.mT).eigenvectors[:, -rank:].flip(1)
        for iteration in range(20 if robust else 1):
            problem = low_rank_problem(samples[None], weights[None], left[None])
            steps = _NEXT_STEPS if iteration else _FIRST_STEPS
            solved = solve_variable_projection(problem, steps)
            left = solved.lights[0]
            widen = max(1.0, _WIDEST * _NARROWING_FACTORED**iteration)
            weights = reweigh(samples, prior[:, subset], left @ solved.shading[0], widen)
        return regress(x, prior, left, robust=robust)
