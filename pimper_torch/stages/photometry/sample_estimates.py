"""Flattened samples of rasters; their albedo, normal and variance for given lights."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from pimper_torch.lighting.light_field import harmonics
from pimper_torch.records import Observations, Record, Templates
from pimper_torch.records.shapes import PatchMask, PatchVectors
from pimper_torch.stages.photometry import bilinear
from pimper_torch.stages.photometry.bilinear import Bilinear, Entries, Factors, Lights, Shading
from pimper_torch.stages.photometry.quadratics import apply_packed, solve_packed


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FlatSamples(Record):
    """The samples inside each patch's template, flattened and padded to the longest.

    Attributes:
        index: Index of each sample in the flattened raster; padding indexes samples outside
            the template.
        radiance: Linear; zero where missing.
        seen: ``D``; false where radiance is not finite.
        normals: Initial normals of the template, patch frame.
    """

    index: Int[Tensor, "patch sample"]
    radiance: Float[Tensor, "patch view channel sample"]
    seen: Bool[Tensor, "patch view sample"]
    normals: Float[Tensor, "patch sample 3"]

    def only(self, mask: Bool[Tensor, "patch view sample"]) -> "FlatSamples":
        """Return the samples with those outside the mask missing."""
        seen = self.seen & mask
        return self.replace(seen=seen, radiance=torch.where(seen[:, :, None], self.radiance, 0))


def gather_samples(
    templates: Templates, registered: Observations, normals: PatchVectors
) -> FlatSamples:
    """Return the samples inside each template, flattened."""
    inside = templates.inside.flatten(1)
    longest = max(int(inside.sum(dim=1).max()), 1) if len(inside) else 1
    index = torch.argsort((~inside).to(torch.uint8), dim=1, stable=True)[:, :longest]
    not_padding = inside.gather(1, index)
    num_views, num_channels = registered.radiance.shape[1:3]
    by_channel = index[:, None, None].expand(-1, num_views, num_channels, -1)
    radiance = registered.radiance.flatten(3).gather(3, by_channel)
    seen = flatten_samples(registered.valid, index) & not_padding[:, None]
    # Except for overflow, a sum is finite if all its terms are.
    seen = seen & radiance.sum(dim=2).isfinite()
    return FlatSamples(
        index=index,
        radiance=torch.where(seen[:, :, None], radiance, 0),
        seen=seen,
        normals=normals.flatten(1, 2).gather(1, index[..., None].expand(-1, -1, 3)),
    )


def flatten_samples(
    raster: Shaped[Tensor, "patch view height width"], index: Int[Tensor, "patch sample"]
) -> Shaped[Tensor, "patch view sample"]:
    """Return the samples at flat indices of their rasters."""
    flat = raster.flatten(2)
    return flat.gather(2, index[:, None].expand(-1, flat.shape[1], -1))


def scatter_samples(
    samples: Float[Tensor, "patch sample *channel"] | Bool[Tensor, "patch sample"],
    index: Int[Tensor, "patch sample"],
    background: Float[Tensor, "patch height width *channel"] | PatchMask,
) -> Float[Tensor, "patch height width *channel"] | PatchMask:
    """Return the raster of flattened samples, with the background elsewhere."""
    expanded = index if samples.ndim == 2 else index[..., None].expand_as(samples)
    return background.flatten(1, 2).scatter(1, expanded, samples).reshape(background.shape)


# Weight, in views, of the patch's residual variance in that of a sample, which has few residuals. A
# choice: with it the error of the mean estimated variance is 2 % (`test_sample_estimates.py`).
BORROWED_VIEWS = 4.0


def refine_on_manifold(
    problem: Bilinear, factors: Factors
) -> tuple[
    Float[Tensor, "patch sample"], Float[Tensor, "patch sample 3"], Float[Tensor, "patch sample"]
]:
    r"""Return samples after a last Gauss-Newton step, with the inverse variance of their normals.

    With ``A`` and ``b`` the sample's normal equations and ``B`` the manifold's tangents,
    :math:`\delta = (B^\top A B)^{-1} B^\top (b - A n)`. At a converged solution the step is
    close to zero, and so is its derivative if the factors carry gradients by the implicit
    function (:mod:`~pimper_torch.stages.photometry.factor_gradients`).

    The same matrix determines the variance of the normal, the mean square of its angular error:
    :math:`\sigma^2 = s^2 (C_{11} + C_{22}) / \rho^2` with ``C`` the inverse of
    :math:`B^\top A B` for the tangents that rotate the normal and :math:`s^2` the variance of the
    residuals, the sample's and the patch's pooled. Differentiable in factors and radiance.

    Returns:
        Gray albedo, unit normals, and the normals' inverse variance, one over squared radians; 0
        where they are not determined.
    """
    A, b = bilinear.equations_of_samples(problem, factors.lights, factors.weight)
    slope = b - apply_packed(A, factors.shading)
    moved = bilinear.tangent_step(problem.manifold, A, slope, factors.shading)
    albedo, normals = problem.manifold.split(moved.mT)
    curvature = bilinear.curvature_in(problem.manifold.tangents(factors.shading), A)
    return albedo, normals, _information(problem, factors, curvature)


def fit_albedo(
    radiance: Float[Tensor, "patch view channel sample"],
    weight: Entries,
    lights: Lights,
    basis: Shading,
) -> Float[Tensor, "patch channel sample"]:
    """Return every channel's least-squares albedo for given lights and normals.

    Args:
        radiance: Linear.
        weight: Weight of each entry, the same for all channels.
        lights: The same for all channels.
        basis: Harmonics of the normals.

    It is not negative, and zero where no view is lit. Differentiable.
    """
    shading = lights @ basis
    weighted = weight * shading
    square = (weighted * shading).sum(dim=1)[:, None]
    product = (weighted[:, :, None] * radiance).sum(dim=1)
    lit = square > torch.finfo(square.dtype).tiny ** 0.5
    return torch.where(lit, product / torch.where(lit, square, 1), 0).clamp_min(0)


def initial_shading(
    radiance: Entries, seen: Bool[Tensor, "patch view sample"], lights: Lights, basis: Shading
) -> Shading:
    """Return shading vectors in the directions of ``basis``, with the least-squares albedo."""
    weight = seen.to(radiance.dtype)
    return fit_albedo(radiance[:, :, None], weight, lights, basis) * basis


def exposed_lights(rows: FlatSamples, lights: Lights) -> Lights:
    """Return lights scaled to the radiance of each view, for coarse normals and a common albedo."""
    gray, basis = rows.radiance.mean(dim=2), harmonics(rows.normals).mT
    predicted = lights @ initial_shading(gray, rows.seen, lights, basis) * rows.seen
    square = predicted.square().sum(dim=2)
    gain = (predicted * gray).sum(dim=2) / torch.where(square > 0, square, 1)
    return lights * torch.where((square > 0) & (gain > 0), gain, 1)[..., None]


def _information(
    problem: Bilinear, factors: Factors, curvature: Float[Tensor, "patch 6 sample"]
) -> Float[Tensor, "patch sample"]:
    """Return the inverse variance of the normals; 0 where they are not determined."""
    residual = problem.radiance - factors.lights @ factors.shading
    square = (factors.weight * residual**2).sum(dim=1)
    count = factors.weight.sum(dim=1)
    # Albedo and normal use 3 degrees of freedom of a sample's views.
    redundancy = (count - 3).clamp_min(0)
    pooled = square.sum(dim=1) / redundancy.sum(dim=1).clamp_min(1)
    variance = (square + BORROWED_VIEWS * pooled[:, None]) / (redundancy + BORROWED_VIEWS)
    angular = torch.zeros_like(square)
    for angle in (1, 2):
        unit = torch.zeros_like(factors.shading[:, :3])
        unit[:, angle] = 1
        angular = angular + solve_packed(curvature, unit)[:, angle]
    albedo, _ = problem.manifold.split(factors.shading.mT)
    square = albedo**2
    # Beyond these limits the derivative exceeds the dtype's range.
    kind = torch.finfo(square.dtype)
    error = variance * angular / square
    determined = (angular > 0) & (square > kind.tiny**0.5) & (error < kind.max**0.5)
    error = torch.where(determined, variance * angular, 1)
    error = error / torch.where(determined, square, 1)
    # Without residuals the standard error of a normal is single precision.
    return torch.where(determined, 1 / error.clamp_min(1e-7**2), 0)
