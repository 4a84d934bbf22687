r"""Augmented Lagrangian factorization: BALM.

``N`` is split in two: ``S`` free, where the data is, and ``N`` on the cone. Multipliers and
a growing penalty :math:`\mu` drive them together,

.. math::

    \lVert \sqrt W (J - L S) \rVert^2 + \mu \lVert S - N + U \rVert^2,

and each step has a closed form: a 4 x 4 system a sample for ``S``, the projection on the
cone for ``N``, a 4 x 4 system a view for ``L``. Missing entries need no filling, as their
weights are 0; robust weights take part the same way.

Source: Del Bue, Xavier, Agapito & Paladini, Bilinear modelling via augmented Lagrange
multipliers, PAMI 34(8), 2012.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.photometry.bilinear import (
    Bilinear,
    Factors,
    equations_of_samples,
    equations_of_views,
    finish,
    geometry_of_samples,
    reweigh,
    select,
)
from pimper_torch.photometry.cone import project_to_cone
from pimper_torch.photometry.quadratics import diagonal, solve_packed
from pimper_torch.records import Record

# The penalty starts at this share of what the data knows about a sample, per unknown; it
# grows by the factor below each step up to the cap. A stiff penalty ties lights and shading
# to each other, and both crawl: of 0.01 to 0.3, this start needed the fewest steps to a
# residual of 1e-8 with 60 % of the entries missing.
PENALTY_START = 0.03
PENALTY_GROWTH = 1.01
PENALTY_CAP = 1.0

# Robust weights follow the residuals every so many steps: they change slowly, and their
# medians cost as much as a step.
REWEIGH_EVERY = 3

# Patches that are done leave the batch when they are this share of it.
COMPACT_SHARE = 0.25


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _State(Record):
    lights: Float[Tensor, "patch view 4"]
    shading: Float[Tensor, "patch 4 sample"]
    multiplier: Float[Tensor, "patch 4 sample"]
    weight: Float[Tensor, "patch view sample"]
    size: Float[Tensor, " patch"]


def solve_balm(problem: Bilinear, max_iterations: int, tolerance: float) -> Factors:
    """Factorize a batch of patches by augmented Lagrangian.

    Args:
        problem: With its start.
        max_iterations: Steps at most.
        tolerance: A patch is done, and leaves the batch, when in one step neither its
            shading vectors nor their distance from the cone changed or remained by more
            than this share of their length.

    Returns:
        Factors with ``N`` exactly on the cone. Without ``pull`` the scale between albedo
        and light is kept where it started. A patch without data keeps its start.

    Constant to autograd. Patches do not influence one another.
    """
    with torch.no_grad():
        count = len(problem.radiance)
        patches = torch.arange(count, device=problem.radiance.device)
        state, work = _start(problem), problem
        lights, shading = state.lights.clone(), state.shading.clone()
        weight = state.weight.clone()
        taken = torch.full((count,), max_iterations, device=patches.device)
        running = torch.ones_like(patches, dtype=torch.bool)
        for step in range(max_iterations):
            state, change = _step(work, state, step)
            ended = running & (change <= tolerance) & (step >= REWEIGH_EVERY)
            _store(patches[ended], ended, state, lights, shading, weight)
            taken[patches[ended]] = step + 1
            running = running & ~ended
            if not running.any():
                break
            if (~running).float().mean() >= COMPACT_SHARE:
                keep = running.nonzero()[:, 0]
                state, work, patches = select(state, keep), select(work, keep), patches[keep]
                running = running[keep]
        _store(patches[running], running, state, lights, shading, weight)
        return finish(problem, lights, shading, weight, taken, max_iterations)


def _start(problem: Bilinear) -> _State:
    return _State(
        lights=problem.lights,
        shading=problem.shading,
        multiplier=torch.zeros_like(problem.shading),
        weight=reweigh(problem, problem.lights, problem.shading),
        size=(problem.lights**2).sum(dim=(1, 2)),
    )


def _step(problem: Bilinear, state: _State, step: int) -> tuple[_State, Float[Tensor, " patch"]]:
    weight = state.weight
    if step and step % REWEIGH_EVERY == 0 and problem.robust_scale is not None:
        weight = reweigh(problem, state.lights, state.shading)
    A, b = equations_of_samples(problem, state.lights, weight)
    trace = A[:, diagonal(4)].sum(dim=1)
    seen = trace > 0
    share = min(PENALTY_START * PENALTY_GROWTH**step, PENALTY_CAP)
    penalty = share * trace.sum(dim=1) / (4 * seen.sum(dim=1)).clamp_min(1)
    penalty = penalty.clamp_min(torch.finfo(A.dtype).tiny ** 0.5)[:, None, None]
    if (problem.geometry > 0).any():
        A = A + geometry_of_samples(problem)
    A[:, diagonal(4)] += penalty
    free = solve_packed(A, b + penalty * (state.shading - state.multiplier))
    shading = project_to_cone((free + state.multiplier).mT).mT
    multiplier = state.multiplier + free - shading
    lights = solve_packed(*equations_of_views(problem, free, weight)).mT
    size = shading.norm(dim=(1, 2)).clamp_min(torch.finfo(A.dtype).tiny ** 0.5)
    change = (shading - state.shading).norm(dim=(1, 2)).maximum((free - shading).norm(dim=(1, 2)))
    found = state.replace(lights=lights, shading=shading, multiplier=multiplier, weight=weight)
    return _keep_scale(problem, found), change / size


def _keep_scale(problem: Bilinear, state: _State) -> _State:
    """Hold the size of the lights where nothing else does."""
    size = (state.lights**2).sum(dim=(1, 2))
    free = (problem.pull.amax(dim=1) == 0) & (size > 0) & (state.size > 0)
    factor = torch.where(free, (state.size / torch.where(free, size, 1)).sqrt(), 1)[:, None, None]
    return state.replace(
        lights=state.lights * factor,
        shading=state.shading / factor,
        multiplier=state.multiplier / factor,
    )


def _store(
    patches: Int[Tensor, " chosen"],
    rows: Tensor,
    state: _State,
    lights: Float[Tensor, "patch view 4"],
    shading: Float[Tensor, "patch 4 sample"],
    weight: Float[Tensor, "patch view sample"],
) -> None:
    lights[patches] = state.lights[rows]
    shading[patches] = state.shading[rows]
    weight[patches] = state.weight[rows]
