"""The solution of the problem of a batch of patches, as rasters of albedo, normals and lights."""

from functools import partial

import torch
from jaxtyping import Int
from torch import Tensor

from pimper_torch.lighting.light_field import harmonics
from pimper_torch.records import PatchStatus, Photometry
from pimper_torch.records.shapes import PatchVectors
from pimper_torch.runtime.failures import skipped_patches
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.memory import recomputed
from pimper_torch.stages.photometry.balm import solve_balm
from pimper_torch.stages.photometry.bilinear import Bilinear, Factors, Solver
from pimper_torch.stages.photometry.factor_gradients import differentiable
from pimper_torch.stages.photometry.photometry_config import FactorizeConfig
from pimper_torch.stages.photometry.sample_estimates import (
    FlatSamples,
    fit_albedo,
    refine_on_manifold,
    scatter_samples,
)
from pimper_torch.stages.photometry.variable_projection import solve_variable_projection

SOLVERS: dict[str, Solver] = {
    # 256 samples are about ten per light of 24 views.
    "variable-projection": partial(solve_variable_projection, small_steps=1, curvature_samples=256),
    "balm": solve_balm,
}

# Maximum number of iterations and tolerance if gradients are required: Newton's method then
# converged to rounding in all of 60 patches of a sphere; from the default tolerance, in 37.
TO_CONVERGENCE = 300, 1e-9

_COARSE_NORMALS = "These patches keep the coarse mesh's normals"


def solve(problem: Bilinear, config: FactorizeConfig) -> Factors:
    """Return the solution of the configured solver; differentiable if gradients are enabled."""
    limits, dtype = (config.max_iterations, config.tolerance), problem.radiance.dtype
    solver, gradients = SOLVERS[config.solver], torch.is_grad_enabled() and problem.requires_grad
    if not gradients:
        return solver(problem.detach(), *limits).to(dtype)
    limits = max(limits[0], TO_CONVERGENCE[0]), min(limits[1], TO_CONVERGENCE[1])
    # Newton's method continues in float64.
    return differentiable(problem, solver(problem.to(torch.float32).detach(), *limits).to(dtype))


def photometry_of(
    problem: Bilinear,
    factors: Factors,
    rows: FlatSamples,
    status: Int[Tensor, " patch"],
    surface_normals: PatchVectors,
    facets: Int[Tensor, " patch"],
    min_views: int,
) -> Photometry:
    """Return the solution of a problem as rasters; where it is not valid, surface normals.

    Args:
        status: Status of the patches before the solution.
        min_views: Number of views in which valid samples are seen.
    """
    gray, normals, information = recomputed(refine_on_manifold, problem, factors)
    views = rows.seen.shape[1]  # a further view represents the prior of albedo
    lights, weight = factors.lights[:, :views], factors.weight[:, :views]
    prior_mean, initial_weight = problem.prior_mean[:, :views], problem.weight[:, :views]
    finite = lights.isfinite().flatten(1).all(dim=1)
    estimated = normals.isfinite().all(dim=2) & gray.isfinite()
    estimated &= (gray > 0) & (rows.seen.sum(dim=1) >= min_views)
    outvoted = (weight < initial_weight / 2) & rows.seen
    leave_out("photometry.robust", int(outvoted.sum()), total=int(rows.seen.sum()))
    failed = (status == int(PatchStatus.DETERMINED)) & ~(finite & estimated.any(dim=1))
    status = torch.where(failed, int(PatchStatus.FAILED), status)
    reason = "the solver found no finite solution"
    skipped_patches("factorize", facets[failed], reason, _COARSE_NORMALS)
    determined = (status == int(PatchStatus.DETERMINED))[:, None]
    valid = estimated & determined & (normals[..., 2] < 0)
    fitted = finite & rows.seen.flatten(1).any(dim=1)
    lights = torch.where(fitted[:, None, None], lights, prior_mean)
    lights = lights * rows.seen.any(dim=2)[..., None]
    normals = torch.where(valid[..., None], normals, rows.normals)
    weight = torch.where(determined[..., None], weight, initial_weight)
    basis = harmonics(normals).mT
    albedo = recomputed(fit_albedo, rows.radiance, weight, lights, basis)
    blank = torch.zeros_like(surface_normals[..., 0])
    black = blank[..., None].expand(-1, -1, -1, albedo.shape[1])
    residual = factors.convergence.residual
    finite_residual = torch.where(residual.isfinite() | ~failed, residual, 0)
    return Photometry(
        normals_patch=scatter_samples(normals, rows.index, surface_normals),
        albedo=scatter_samples(albedo.mT, rows.index, black),
        lights_patch=lights,
        valid=scatter_samples(valid, rows.index, blank > 0),
        information=scatter_samples(information * valid, rows.index, blank),
        status=status,
        convergence=factors.convergence.replace(residual=finite_residual),
    )
