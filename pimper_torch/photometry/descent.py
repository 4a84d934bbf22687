"""Factorization by gradient descent with projection: the second opinion.

The gradient comes from autograd, so that another loss or a learned prior is one more term of
the objective. Each step goes down the gradient along the cone, scaled by the curvature of
its own block, and is projected back on the cone.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.photometry.balm import REWEIGH_EVERY
from pimper_torch.photometry.bilinear import (
    Bilinear,
    Factors,
    equations_of_samples,
    equations_of_views,
    finish,
    geometry_of_samples,
    objective,
    reweigh,
)
from pimper_torch.photometry.cone import project_to_cone, tangent_columns
from pimper_torch.photometry.quadratics import congruence, solve_packed


def solve_descent(problem: Bilinear, max_iterations: int, tolerance: float) -> Factors:
    """Factorize a batch of patches by preconditioned, accelerated descent.

    Args:
        problem: With its start.
        max_iterations: Steps at most; it needs several times as many as BALM.
        tolerance: A patch is done when a step moved its shading vectors by less than this
            share of their length.

    Returns:
        Factors with ``N`` on the cone; the same minimum as BALM's where there is one.

    Half a Newton step of every block is tried, as two blocks curve into each other at most
    by that; where it fails to descend, half of it. Momentum (Nesterov's) restarts in a patch
    whose objective went up. Constant to autograd. Patches do not influence one another, save
    that all go on until the last.
    """
    lights, shading = problem.lights.detach(), problem.shading.detach()
    weight = reweigh(problem, lights, shading)
    before_lights, before_shading = lights, shading
    momentum = torch.ones(len(lights), dtype=lights.dtype, device=lights.device)
    stride = torch.full_like(momentum, 0.5)
    cost = objective(problem, lights, shading, weight)
    taken = torch.full((len(lights),), max_iterations, device=lights.device)
    for step in range(max_iterations):
        following = (1 + (1 + 4 * momentum**2).sqrt()) / 2
        push = ((momentum - 1) / following)[:, None, None]
        ahead_lights = lights + push * (lights - before_lights)
        ahead_shading = shading + push * (shading - before_shading)
        moved = _descend(problem, ahead_lights, ahead_shading, weight, stride)
        found = objective(problem, *moved, weight)
        better = found <= cost
        shorter = torch.where(momentum == 1, stride / 2, stride)
        stride = torch.where(better, (1.2 * stride).clamp_max(0.5), shorter)
        momentum = torch.where(better, following, 1.0).to(lights.dtype)
        keep = better[:, None, None]
        before_lights, before_shading = lights, shading
        lights = torch.where(keep, moved[0], lights)
        shading = torch.where(keep, moved[1], shading)
        cost = torch.where(better, found, cost)
        if problem.robust_scale is not None and step % REWEIGH_EVERY == REWEIGH_EVERY - 1:
            weight = reweigh(problem, lights, shading)
            cost = objective(problem, lights, shading, weight)
        size = shading.norm(dim=(1, 2)).clamp_min(torch.finfo(shading.dtype).tiny ** 0.5)
        change = (shading - before_shading).norm(dim=(1, 2)) / size
        small = (better & (change <= tolerance)) | (stride < 1e-6)
        done = small & (taken == max_iterations)
        taken = torch.where(done, step + 1, taken)
        if (taken < max_iterations).all():
            break
    return finish(problem, lights, shading, weight, taken, max_iterations)


def _descend(
    problem: Bilinear,
    lights: Float[Tensor, "patch view 4"],
    shading: Float[Tensor, "patch 4 sample"],
    weight: Float[Tensor, "patch view sample"],
    stride: Float[Tensor, " patch"],
) -> tuple[Float[Tensor, "patch view 4"], Float[Tensor, "patch 4 sample"]]:
    shading = project_to_cone(shading.mT).mT
    with torch.enable_grad():
        L, N = lights.detach().requires_grad_(), shading.detach().requires_grad_()
        total = objective(problem, L, N, weight).sum()
        on_lights, on_shading = torch.autograd.grad(total, (L, N))
    # The gradient is twice the residual of the normal equations.
    part = stride[:, None, None] / 2
    per_view, _ = equations_of_views(problem, shading, weight)
    per_sample, _ = equations_of_samples(problem, lights, weight)
    columns = tangent_columns(shading)
    along = congruence(per_sample + geometry_of_samples(problem), columns)
    slope = torch.stack([(column * on_shading).sum(dim=1) for column in columns], dim=1)
    down = solve_packed(along, part * slope)
    step = sum((column * down[:, None, i] for i, column in enumerate(columns)), start=0 * shading)
    lights = lights - solve_packed(per_view, part * on_lights.mT).mT
    return lights, project_to_cone((shading - step).mT).mT
