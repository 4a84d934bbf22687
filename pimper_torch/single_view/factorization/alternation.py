"""Alternating least squares: shading vectors with lights fixed, then lights with shading fixed.

Every step has a closed form and the objective never rises, but convergence is slow where lights
and shading are correlated: the baseline of the other solvers.
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
    keep_scale,
    objective,
    robust_weights,
    update_shading,
)
from pimper_torch.photometry.iteration import RUNNING, State, iterate
from pimper_torch.photometry.quadratics import solve_packed
from pimper_torch.photometry.robust import Squares
from pimper_torch.records import StopCause


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _State(State):
    cost: Float[Tensor, " patch"]


def solve_alternation(problem: Bilinear, max_iterations: int, tolerance: float) -> Factors:
    """Factorize a batch of patches by alternating least squares.

    Args:
        tolerance: A patch has converged when a step lowers its objective by less than this
            fraction.

    On a curved manifold the samples take one Gauss-Newton step per iteration. Lights without
    ``regularization`` keep their initial scale. Constant to autograd. Patches are independent.
    """

    def advance(work: Bilinear, state: _State, step: int) -> tuple[_State, Int[Tensor, " patch"]]:
        weight, cost = state.weight, state.cost
        if step % REWEIGHT_EVERY == 0 and step and not isinstance(work.loss, Squares):
            weight = robust_weights(work, state.lights, state.shading)
            cost = objective(work, state.lights, state.shading, weight)
        lights = solve_packed(*equations_of_views(work, state.shading, weight)).mT
        lights, shading = keep_scale(work, state.lights, lights, state.shading)
        shading = update_shading(work, *equations_of_samples(work, lights, weight), shading)
        after = objective(work, lights, shading, weight)
        done = (cost - after <= tolerance * cost) & (step >= REWEIGHT_EVERY)
        cause = torch.where(done, int(StopCause.CONVERGED), RUNNING)
        return _State(lights=lights, shading=shading, weight=weight, cost=after), cause

    with torch.no_grad():
        weight = robust_weights(problem, problem.lights, problem.shading)
        start = _State(
            lights=problem.lights,
            shading=problem.shading,
            weight=weight,
            cost=objective(problem, problem.lights, problem.shading, weight),
        )
        return iterate(problem, start, advance, max_iterations)
