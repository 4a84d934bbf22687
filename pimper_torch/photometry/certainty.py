"""Sample by sample: albedo under given normals, the exact minimum on the manifold, and how sure."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.photometry.bilinear import (
    Bilinear,
    Factors,
    curvature_along,
    equations_of_samples,
    step_along,
)
from pimper_torch.photometry.quadratics import apply_packed, solve_packed
from pimper_torch.records import Record

# A normal whose standard error is this counts half.
HALF_CONFIDENCE_DEG = 8.0

# A sample's own residuals are few; the patch's spread joins as if it were so many views.
BORROWED_VIEWS = 4.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Certain(Record):
    """Samples at the minimum.

    Attributes:
        albedo: Gray.
        normals: Unit.
        confidence: In (0, 1], where the equations allow any.
    """

    albedo: Float[Tensor, "patch sample"]
    normals: Float[Tensor, "patch sample 3"]
    confidence: Float[Tensor, "patch sample"]


def refine_on_manifold(problem: Bilinear, factors: Factors) -> Certain:
    r"""Take each sample's Newton step along the manifold, with lights and weights given.

    With ``A`` and ``b`` the sample's normal equations and ``B`` the manifold's tangents,
    :math:`\delta = (B^\top A B)^{-1} B^\top (b - A n)`. At a converged solution the step is
    next to nothing, and so is its derivative if the factors carry gradients by the implicit
    function (:mod:`~pimper_torch.photometry.implicit`).

    The same matrix tells the standard error of the normal, :math:`\sigma^2 = s^2
    (C_{11} + C_{22}) / \rho^2` with ``C`` the inverse of :math:`B^\top A B` for the tangents
    that turn the normal and ``s`` the spread of the residuals, the sample's and the patch's
    pooled. Confidence is :math:`1 / (1 + (\sigma / 8°)^2)`: many views, lights that differ,
    brightness and small residuals all raise it. Differentiable in factors and radiance.
    """
    A, b = equations_of_samples(problem, factors.lights, factors.weight)
    slope = b - apply_packed(A, factors.shading)
    moved = step_along(problem.manifold, A, slope, factors.shading)
    albedo, normals = problem.manifold.split(moved.mT)
    curvature = curvature_along(problem.manifold.tangents(factors.shading), A)
    error = _standard_error(problem, factors, curvature)
    half = math.radians(HALF_CONFIDENCE_DEG)
    confidence = 1 / (1 + (error / half) ** 2)
    return Certain(albedo=albedo, normals=normals, confidence=confidence.nan_to_num(nan=0.0))


def fit_albedo(
    radiance: Float[Tensor, "patch view channel sample"],
    weight: Float[Tensor, "patch view sample"],
    lights: Float[Tensor, "patch view rank"],
    basis: Float[Tensor, "patch rank sample"],
) -> Float[Tensor, "patch channel sample"]:
    """Give every channel's albedo in closed form, lights and normals given.

    Args:
        radiance: Linear.
        weight: Of each entry, alike for all channels.
        lights: Alike for all channels.
        basis: What albedo 1 makes of the normals.

    Not negative; zero where nothing is lit. Differentiable.
    """
    shading = lights @ basis
    lit = weight * shading
    square = (lit * shading).sum(dim=1)[:, None]
    product = torch.einsum("pfk,pfck->pck", lit, radiance)
    some = square > torch.finfo(square.dtype).tiny ** 0.5
    return torch.where(some, product / torch.where(some, square, 1), 0).clamp_min(0)


def start_from_mesh(
    radiance: Float[Tensor, "patch view sample"],
    seen: Bool[Tensor, "patch view sample"],
    lights: Float[Tensor, "patch view rank"],
    basis: Float[Tensor, "patch rank sample"],
) -> Float[Tensor, "patch rank sample"]:
    """Give shading vectors along a basis, that of the mesh's normals, with the best albedo."""
    weight = seen.to(radiance.dtype)
    return fit_albedo(radiance[:, :, None], weight, lights, basis) * basis


def _standard_error(
    problem: Bilinear, factors: Factors, curvature: Float[Tensor, "patch 6 sample"]
) -> Float[Tensor, "patch sample"]:
    residual = problem.radiance - factors.lights @ factors.shading
    square = (factors.weight * residual**2).sum(dim=1)
    count = factors.weight.sum(dim=1)
    # A sample with m views has spent 3 of them on its own albedo and normal.
    pooled = square.sum(dim=1) / (count - 3).clamp_min(0).sum(dim=1).clamp_min(1)
    spread = (square + BORROWED_VIEWS * pooled[:, None]) / (
        (count - 3).clamp_min(0) + BORROWED_VIEWS
    )
    variance = torch.zeros_like(square)
    for place in (1, 2):
        unit = torch.zeros_like(factors.shading[:, :3])
        unit[:, place] = 1
        variance = variance + solve_packed(curvature, unit)[:, place]
    albedo, _ = problem.manifold.split(factors.shading.mT)
    some = (albedo > 0) & (spread * variance > 0)
    error = torch.where(some, spread * variance, 1).sqrt() / torch.where(some, albedo, 1)
    exact = (albedo > 0) & (variance > 0) & (spread == 0)
    return torch.where(some, error, torch.where(exact, 0, torch.inf))
