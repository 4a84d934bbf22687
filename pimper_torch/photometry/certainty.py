"""Sample by sample: albedo under given normals, the minimum on the manifold, and its variance."""

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

# A sample's own residuals are few; the patch's variance joins as if it were so many views. A
# choice: with it the mean claimed variance is right to 2 % (`test_certainty.py`).
BORROWED_VIEWS = 4.0

# Standard error of a normal without residuals, radians: the rounding of single precision.
_ROUNDING = 1e-7


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Certain(Record):
    """Samples at the minimum.

    Attributes:
        albedo: Gray.
        normals: Unit.
        information: Inverse variance of the normals, one over squared radians; 0 where the
            equations do not determine them.
    """

    albedo: Float[Tensor, "patch sample"]
    normals: Float[Tensor, "patch sample 3"]
    information: Float[Tensor, "patch sample"]


def refine_on_manifold(problem: Bilinear, factors: Factors) -> Certain:
    r"""Take each sample's Newton step along the manifold, with lights and weights given.

    With ``A`` and ``b`` the sample's normal equations and ``B`` the manifold's tangents,
    :math:`\delta = (B^\top A B)^{-1} B^\top (b - A n)`. At a converged solution the step is
    next to nothing, and so is its derivative if the factors carry gradients by the implicit
    function (:mod:`~pimper_torch.photometry.implicit`).

    The same matrix gives the variance of the normal, the mean square of its angular error:
    :math:`\sigma^2 = s^2 (C_{11} + C_{22}) / \rho^2` with ``C`` the inverse of
    :math:`B^\top A B` for the tangents that rotate the normal and :math:`s^2` the variance of the
    residuals, the sample's and the patch's pooled. Differentiable in factors and radiance.
    """
    A, b = equations_of_samples(problem, factors.lights, factors.weight)
    slope = b - apply_packed(A, factors.shading)
    moved = step_along(problem.manifold, A, slope, factors.shading)
    albedo, normals = problem.manifold.split(moved.mT)
    curvature = curvature_along(problem.manifold.tangents(factors.shading), A)
    information = _information(problem, factors, curvature)
    return Certain(albedo=albedo, normals=normals, information=information)


def fit_albedo(
    radiance: Float[Tensor, "patch view channel sample"],
    weight: Float[Tensor, "patch view sample"],
    lights: Float[Tensor, "patch view rank"],
    basis: Float[Tensor, "patch rank sample"],
) -> Float[Tensor, "patch channel sample"]:
    """Give every channel's albedo in closed form, lights and normals given.

    Args:
        radiance: Linear.
        weight: Of each entry, the same for all channels.
        lights: The same for all channels.
        basis: Harmonics of the normals.

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


def _information(
    problem: Bilinear, factors: Factors, curvature: Float[Tensor, "patch 6 sample"]
) -> Float[Tensor, "patch sample"]:
    """Give the inverse variance of the normals; 0 where they are not determined."""
    residual = problem.radiance - factors.lights @ factors.shading
    square = (factors.weight * residual**2).sum(dim=1)
    count = factors.weight.sum(dim=1)
    # A sample with m views has spent 3 of them on its own albedo and normal.
    pooled = square.sum(dim=1) / (count - 3).clamp_min(0).sum(dim=1).clamp_min(1)
    variance = (square + BORROWED_VIEWS * pooled[:, None]) / (
        (count - 3).clamp_min(0) + BORROWED_VIEWS
    )
    spread = torch.zeros_like(square)
    for angle in (1, 2):
        unit = torch.zeros_like(factors.shading[:, :3])
        unit[:, angle] = 1
        spread = spread + solve_packed(curvature, unit)[:, angle]
    albedo, _ = problem.manifold.split(factors.shading.mT)
    determined = (albedo > 0) & (spread > 0) & variance.isfinite()
    error = torch.where(determined, variance * spread, 1) / torch.where(determined, albedo, 1) ** 2
    return torch.where(determined, 1 / error.clamp_min(_ROUNDING**2), 0)
