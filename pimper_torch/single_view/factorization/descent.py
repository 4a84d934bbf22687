"""Factorization by preconditioned Riemannian gradient descent.

The gradient comes from autograd, so that another loss or a learned prior is one more term of
the objective. Each step follows the gradient along the manifold, preconditioned by its own
block of the Hessian, and is retracted to the manifold.

Source: Absil, Mahony & Sepulchre, Optimization Algorithms on Matrix Manifolds, 2008.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.photometry.bilinear import (
    REWEIGHT_EVERY,
    Bilinear,
    Factors,
    equations_of_samples,
    equations_of_views,
    objective,
    robust_weights,
)
from pimper_torch.photometry.iteration import RUNNING, State, iterate
from pimper_torch.photometry.quadratics import (
    combination,
    congruence,
    coordinates,
    solve_packed,
)
from pimper_torch.photometry.robust import Squares
from pimper_torch.records import StopCause

# Smallest step, as a fraction of Newton's, in the line search: a choice.
_MIN_STRIDE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _State(State):
    before_lights: Float[Tensor, "patch view rank"]
    before_shading: Float[Tensor, "patch rank sample"]
    cost: Float[Tensor, " patch"]
    momentum: Float[Tensor, " patch"]
    stride: Float[Tensor, " patch"]


def solve_descent(problem: Bilinear, max_iterations: int, tolerance: float) -> Factors:
    """Factorize a batch of patches by preconditioned, accelerated descent.

    Args:
        problem: With its initial values.
        max_iterations: Steps at most; it needs several times as many as BALM.
        tolerance: A patch has converged when a step moves its shading vectors by less than this
            fraction of their length.

    Returns:
        Factors with ``N`` on the manifold; the same minimum as BALM's where there is one.

    Steps start at half a Newton step of every block, which bounds the coupling of two blocks;
    one that does not descend is halved. Nesterov's momentum restarts in a patch whose objective
    rises. Constant to autograd. Patches are independent.
    """

    def advance(work: Bilinear, state: _State, step: int) -> tuple[_State, Int[Tensor, " patch"]]:
        state, better = _step(work, state)
        if not isinstance(work.loss, Squares) and step % REWEIGHT_EVERY == REWEIGHT_EVERY - 1:
            weight = robust_weights(work, state.lights, state.shading)
            cost = objective(work, state.lights, state.shading, weight)
            state = state.replace(weight=weight, cost=cost)
        size = state.shading.norm(dim=(1, 2)).clamp_min(torch.finfo(weight_type).tiny ** 0.5)
        change = (state.shading - state.before_shading).norm(dim=(1, 2)) / size
        done = better & (change <= tolerance)
        cause = torch.where(done, int(StopCause.CONVERGED), RUNNING)
        stalled = (state.stride < _MIN_STRIDE) & ~done
        return state, torch.where(stalled, int(StopCause.STALLED), cause)

    lights, shading = problem.lights.detach(), problem.shading.detach()
    weight_type = lights.dtype
    weight = robust_weights(problem, lights, shading)
    one = torch.ones_like(weight[:, 0, 0])
    start = _State(
        lights=lights,
        shading=shading,
        before_lights=lights,
        before_shading=shading,
        weight=weight,
        cost=objective(problem, lights, shading, weight),
        momentum=one,
        stride=one / 2,
    )
    return iterate(problem, start, advance, max_iterations)


def _step(problem: Bilinear, state: _State) -> tuple[_State, Tensor]:
    next_momentum = (1 + (1 + 4 * state.momentum**2).sqrt()) / 2
    extrapolation = ((state.momentum - 1) / next_momentum)[:, None, None]
    lights = state.lights + extrapolation * (state.lights - state.before_lights)
    shading = state.shading + extrapolation * (state.shading - state.before_shading)
    moved = _descend(problem, lights, shading, state.weight, state.stride)
    found = objective(problem, *moved, state.weight)
    better = found <= state.cost
    shorter = torch.where(state.momentum == 1, state.stride / 2, state.stride)
    keep = better[:, None, None]
    state = state.replace(
        lights=torch.where(keep, moved[0], state.lights),
        shading=torch.where(keep, moved[1], state.shading),
        before_lights=state.lights,
        before_shading=state.shading,
        cost=torch.where(better, found, state.cost),
        momentum=torch.where(better, next_momentum, 1.0).to(lights.dtype),
        stride=torch.where(better, (1.2 * state.stride).clamp_max(0.5), shorter),
    )
    return state, better


def _descend(
    problem: Bilinear,
    lights: Float[Tensor, "patch view rank"],
    shading: Float[Tensor, "patch rank sample"],
    weight: Float[Tensor, "patch view sample"],
    stride: Float[Tensor, " patch"],
) -> tuple[Float[Tensor, "patch view rank"], Float[Tensor, "patch rank sample"]]:
    shading = problem.manifold.retract(shading.mT).mT
    with torch.enable_grad():
        L, N = lights.detach().requires_grad_(), shading.detach().requires_grad_()
        total = objective(problem, L, N, weight).sum()
        on_lights, on_shading = torch.autograd.grad(total, (L, N))
    # The gradient is twice the residual of the normal equations.
    part = stride[:, None, None] / 2
    per_view, _ = equations_of_views(problem, shading, weight)
    per_sample, _ = equations_of_samples(problem, lights, weight)
    columns = problem.manifold.tangents(shading)
    along = congruence(per_sample, columns)
    step = combination(columns, solve_packed(along, part * coordinates(columns, on_shading)))
    lights = lights - solve_packed(per_view, part * on_lights.mT).mT
    return lights, problem.manifold.retract((shading - step).mT).mT
