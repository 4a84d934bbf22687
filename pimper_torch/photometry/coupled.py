"""Factorization of all patches together, the lights of neighbours coupled."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.photometry.bilinear import (
    REWEIGH_EVERY,
    Bilinear,
    Factors,
    equations_of_samples,
    equations_of_views,
    finish,
    follow,
    objective,
    reweigh,
)
from pimper_torch.photometry.coupling import couple_lights, couple_steps, disagreement
from pimper_torch.photometry.harmonics import rotate_lights
from pimper_torch.photometry.implicit import answered, eliminated
from pimper_torch.photometry.quadratics import unpacked
from pimper_torch.photometry.robust import Squares
from pimper_torch.records import Record, StopCause


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Batch(Record):
    """Patches that are solved in one batch.

    Attributes:
        problem: Theirs; its ``anchor`` is the light that neighbours should differ from alike.
        patch_from_world: Rigid.
        facet: Of each patch.
    """

    problem: Bilinear
    patch_from_world: Float[Tensor, "patch 4 4"]
    facet: Int[Tensor, " patch"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _State(Record):
    lights: Float[Tensor, "patch view 4"]
    shading: Float[Tensor, "patch 4 sample"]
    weight: Float[Tensor, "patch view sample"]


def solve_coupled(
    batches: Sequence[Batch],
    pairs: Int[Tensor, "pair 2"],
    coupling: float,
    max_iterations: int,
    tolerance: float,
) -> tuple[Factors, ...]:
    r"""Factorize patches whose lights hold to their neighbours', by alternation.

    The objective of every patch, and :math:`s_g \sum \lVert x_\mu - x_{\mu'} \rVert^2` over
    views g and neighbours, where ``x`` is what a light differs from its anchor by, in the world
    frame. In turn all samples are brought to their minimum, and all lights by one sparse solve
    a view; neither raises the objective.

    Args:
        batches: All patches.
        pairs: Facets that are neighbours.
        coupling: ``s_g`` in units of what a patch's samples say of that view's light, in the
            mean over the patches; infinity for one difference from the anchor for all.
        max_iterations: Turns at most.
        tolerance: A patch is done when its shading vectors changed by less than this share of
            their length; all go on until the last is.

    Constant to autograd.
    """
    with torch.no_grad():
        states = [_start(batch.problem) for batch in batches]
        pairs = _patches_of(batches, pairs)
        strength = strengths(batches, coupling)
        taken = max_iterations
        for step in range(max_iterations):
            lights = couple_lights(*_equations(batches, states), pairs, strength)
            states, change = _follow(batches, states, lights, step)
            if step >= REWEIGH_EVERY and bool((torch.cat(change) <= tolerance).all()):
                taken = step + 1
                break
        return tuple(
            _finished(batch.problem, state, part, taken, tolerance)
            for batch, state, part in zip(batches, states, change, strict=True)
        )


def strengths(batches: Sequence[Batch], coupling: float) -> Float[Tensor, " view"]:
    """Give ``s_g``: the coupling, times what a patch's samples say of a light in the mean."""
    with torch.no_grad():
        information, _ = _equations(batches, [_start(batch.problem) for batch in batches])
        known = information[..., 0, 0] - torch.cat([batch.problem.pull for batch in batches])
        count = (known > 0).sum(dim=0).clamp_min(1)
        strength = coupling * known.sum(dim=0) / count
        return torch.where(known.sum(dim=0) > 0, strength, 1.0)


def differentiable_together(
    batches: Sequence[Batch],
    factors: Sequence[Factors],
    pairs: Int[Tensor, "pair 2"],
    coupling: float,
) -> tuple[Factors, ...]:
    """Let gradients flow from coupled solutions to the data of all patches.

    See :func:`~pimper_torch.photometry.implicit.differentiable`; the lights of all patches
    answer together, by conjugate gradients.
    """
    systems = [
        eliminated(batch.problem, found) for batch, found in zip(batches, factors, strict=True)
    ]
    slopes = torch.cat(
        [_to_world(batch, one.slope) for batch, one in zip(batches, systems, strict=True)]
    )
    with torch.no_grad():
        curvature = torch.cat(
            [_turned(batch, one.hessian.schur) for batch, one in zip(batches, systems, strict=True)]
        )
        strength = strengths(batches, coupling).to(curvature)
    step = couple_steps(curvature, slopes, _patches_of(batches, pairs), strength)
    found, first = [], 0
    for batch, one, solution in zip(batches, systems, factors, strict=True):
        part = step[first : first + len(batch.facet)]
        first += len(batch.facet)
        own = rotate_lights(batch.patch_from_world.to(part), part)
        found.append(answered(solution, one, own))
    return tuple(found)


def coupled_objective(
    batches: Sequence[Batch],
    factors: Sequence[Factors],
    pairs: Int[Tensor, "pair 2"],
    strength: Float[Tensor, " view"],
) -> Float[Tensor, ""]:
    """Evaluate what :func:`solve_coupled` minimises, for finite ``s_g``."""
    own = [
        objective(batch.problem, found.lights, found.shading, found.weight).sum()
        for batch, found in zip(batches, factors, strict=True)
    ]
    apart = [
        _to_world(batch, found.lights - batch.problem.anchor)
        for batch, found in zip(batches, factors, strict=True)
    ]
    across = disagreement(torch.cat(apart), _patches_of(batches, pairs))
    return torch.stack(own).sum() + (strength * across).sum()


def _start(problem: Bilinear) -> _State:
    weight = reweigh(problem, problem.lights, problem.shading)
    return _State(lights=problem.lights, shading=problem.shading, weight=weight)


def _patches_of(batches: Sequence[Batch], pairs: Int[Tensor, "pair 2"]) -> Int[Tensor, "pair 2"]:
    """Turn pairs of facets into pairs of patches, as they stand in the batches."""
    facets = torch.cat([batch.facet for batch in batches])
    place = torch.full((int(facets.max()) + 1,), -1, device=facets.device)
    place[facets] = torch.arange(len(facets), device=facets.device)
    inside = (pairs < len(place)).all(dim=1)
    found = place[pairs[inside]]
    return found[(found >= 0).all(dim=1)]


def _equations(
    batches: Sequence[Batch], states: Sequence[_State]
) -> tuple[Float[Tensor, "patch view 4 4"], Float[Tensor, "patch view 4"]]:
    """Give what every patch says of its lights' difference from the anchor, world frame."""
    matrices, sides = [], []
    for batch, state in zip(batches, states, strict=True):
        packed, rhs = equations_of_views(batch.problem, state.shading, state.weight)
        A = unpacked(packed, 4).double()
        short = rhs.mT - (A @ batch.problem.anchor.double()[..., None])[..., 0]
        turn = torch.eye(4, dtype=A.dtype, device=A.device).repeat(len(A), 1, 1, 1)
        turn[:, 0, 1:, 1:] = batch.patch_from_world[:, :3, :3]
        matrices.append(turn.mT @ A @ turn)
        sides.append((turn.mT @ short[..., None])[..., 0])
    return torch.cat(matrices), torch.cat(sides)


def _turned(
    batch: Batch, curvature: Float[Tensor, "patch unknown unknown"]
) -> Float[Tensor, "patch unknown unknown"]:
    """Turn second derivatives by the lights to the world frame."""
    views = curvature.shape[1] // 4
    turn = torch.eye(4, dtype=curvature.dtype, device=curvature.device).repeat(len(curvature), 1, 1)
    turn[:, 1:, 1:] = batch.patch_from_world[:, :3, :3]
    blocks = curvature.reshape(len(curvature), views, 4, views, 4)
    return torch.einsum("pai,pfagb,pbj->pfigj", turn, blocks, turn).reshape(curvature.shape)


def _to_world(batch: Batch, lights: Float[Tensor, "patch view 4"]) -> Float[Tensor, "patch view 4"]:
    return rotate_lights(batch.patch_from_world.to(lights).mT, lights)


def _follow(
    batches: Sequence[Batch],
    states: Sequence[_State],
    lights_world: Float[Tensor, "all view 4"],
    step: int,
) -> tuple[list[_State], list[Tensor]]:
    """Bring the samples to their minimum for lights that differ from the anchor so much."""
    moved, change, first = [], [], 0
    for batch, state in zip(batches, states, strict=True):
        problem = batch.problem
        apart = lights_world[first : first + len(batch.facet)].to(problem.anchor)
        first += len(batch.facet)
        lights = problem.anchor + rotate_lights(batch.patch_from_world.to(apart), apart)
        weight = state.weight
        equations = equations_of_samples(problem, lights, weight)
        shading = follow(problem, *equations, state.shading)
        if step % REWEIGH_EVERY == 0 and not isinstance(problem.loss, Squares):
            weight = reweigh(problem, lights, shading)
        size = shading.flatten(1).norm(dim=1).clamp_min(torch.finfo(shading.dtype).tiny ** 0.5)
        change.append((shading - state.shading).flatten(1).norm(dim=1) / size)
        moved.append(_State(lights=lights, shading=shading, weight=weight))
    return moved, change


def _finished(
    problem: Bilinear,
    state: _State,
    change: Float[Tensor, " patch"],
    taken: int,
    tolerance: float,
) -> Factors:
    iterations = torch.full_like(change, taken).long()
    limit = torch.where(change <= tolerance, int(StopCause.CONVERGED), int(StopCause.LIMIT))
    return finish(problem, state.lights, state.shading, state.weight, iterations, limit)
