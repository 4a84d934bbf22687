r"""Augmented Lagrangian factorization: BALM.

``N`` is split in two: ``S`` is free and fits the data, ``N`` is on the manifold. Multipliers ``U``
and an increasing penalty :math:`\mu` make them equal,

.. math::

    \lVert \sqrt W (J - L S) \rVert^2 + \mu \lVert S - N + U \rVert^2,

and each step has a closed form: a small linear system per sample for ``S``, the projection onto
the manifold for ``N``, a small linear system per view for ``L``. Missing entries have weight 0;
robust weights multiply the others.

Source: Del Bue, Xavier, Agapito & Paladini, Bilinear modelling via augmented Lagrange
multipliers, PAMI 34(8), 2012.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.linalg.robust import Squares
from pimper_torch.records import StopCause
from pimper_torch.stages.photometry import bilinear
from pimper_torch.stages.photometry.bilinear import Bilinear, Factors, Shading, State
from pimper_torch.stages.photometry.quadratics import diagonal, solve_packed

# Initial penalty, as a fraction of the mean eigenvalue of a sample's data term; growth factor per
# step; maximum. A stiff penalty couples lights and shading, which slows convergence: of 0.01 to
# 0.3, this start needed the fewest steps to a residual of 1e-8 with 60 % of the entries missing.
PENALTY_START = 0.03
PENALTY_GROWTH = 1.01
PENALTY_CAP = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _State(State):
    multiplier: Shading


def solve_balm(problem: Bilinear, max_iterations: int, tolerance: float) -> Factors:
    """Return the factors of a batch of patches by the augmented Lagrangian.

    Args:
        tolerance: A patch has converged when the last change of its shading vectors and the
            distance of ``S`` from ``N`` are both below this fraction of their length.

    Returns:
        Factors with ``N`` exactly on the manifold. Lights without ``regularization`` keep their
        initial scale. A patch without data keeps its initial values.

    Not differentiable. Patches are independent.
    """

    def advance(work: Bilinear, state: _State, step: int) -> tuple[_State, Int[Tensor, " patch"]]:
        state, change = _step(work, state, step)
        done = (change <= tolerance) & (step >= bilinear.REWEIGHT_EVERY)
        return state, torch.where(done, int(StopCause.CONVERGED), bilinear.RUNNING)

    with torch.no_grad():
        start = _State(
            lights=problem.lights,
            shading=problem.shading,
            multiplier=torch.zeros_like(problem.shading),
            weight=bilinear.robust_weights(problem, problem.lights, problem.shading),
        )
        return bilinear.iterate(problem, start, advance, max_iterations)


def _step(problem: Bilinear, state: _State, step: int) -> tuple[_State, Float[Tensor, " patch"]]:
    weight = state.weight
    if step and step % bilinear.REWEIGHT_EVERY == 0 and not isinstance(problem.loss, Squares):
        weight = bilinear.robust_weights(problem, state.lights, state.shading)
    A, b = bilinear.equations_of_samples(problem, state.lights, weight)
    rank = state.lights.shape[2]
    # The trace of L^T W L, the data term of a sample.
    trace = (weight * state.lights.square().sum(dim=2, keepdim=True)).sum(dim=1)
    observed = trace > 0
    fraction = min(PENALTY_START * PENALTY_GROWTH**step, PENALTY_CAP)
    penalty = fraction * trace.sum(dim=1) / (rank * observed.sum(dim=1)).clamp_min(1)
    penalty = penalty.clamp_min(torch.finfo(A.dtype).tiny ** 0.5)[:, None, None]
    A[:, diagonal(rank)] += penalty
    free = solve_packed(A, b + penalty * (state.shading - state.multiplier))
    shading = problem.manifold.project((free + state.multiplier).mT).mT
    multiplier = state.multiplier + free - shading
    lights = solve_packed(*bilinear.equations_of_views(problem, free, weight)).mT
    length = shading.norm(dim=(1, 2)).clamp_min(torch.finfo(A.dtype).tiny ** 0.5)
    change = (shading - state.shading).norm(dim=(1, 2)).maximum((free - shading).norm(dim=(1, 2)))
    scaled, shading = bilinear.keep_scale(problem, state.lights, lights, shading)
    _, multiplier = bilinear.keep_scale(problem, state.lights, lights, multiplier)
    updated = _State(lights=scaled, shading=shading, multiplier=multiplier, weight=weight)
    return updated, change / length
