r"""Factorization of a matrix that is too large to be solved in one piece.

The published problem, :math:`\min \lVert D \odot (J - L N) \rVert^2` with ``N`` on the
photometric cone, for one matrix of a million samples. The normal equations of the lights are a sum
over samples, and a sample's own vector depends on nothing but the lights: every step of the
augmented Lagrangian walks through the samples in chunks, and its memory beyond ``J``, ``D``
and ``N`` is that of one chunk.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.evidence.baselines.template import Matrix
from pimper_torch.photometry.balm import PENALTY_CAP, PENALTY_GROWTH, PENALTY_START
from pimper_torch.photometry.bilinear import (
    Bilinear,
    equations_of_samples,
    equations_of_views,
)
from pimper_torch.photometry.cone import project_to_cone
from pimper_torch.photometry.quadratics import diagonal, solve_packed
from pimper_torch.records import Record

# Samples in a chunk: its vectors stay in the processor's cache.
CHUNK = 32_768


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Whole(Record):
    """The solution for all samples.

    Attributes:
        lights: ``L``.
        shading: ``N``, columns on the cone.
        iterations: Taken.
        converged: False where the limit of iterations stopped it.
    """

    lights: Float[Tensor, "view 4"]
    shading: Float[Tensor, "4 sample"]
    iterations: int
    converged: bool


def chunks(num_samples: int) -> list[slice]:
    """Split samples into chunks."""
    return [slice(first, first + CHUNK) for first in range(0, num_samples, CHUNK)]


def as_problem(
    matrix: Matrix, lights: Float[Tensor, "view 4"], shading: Float[Tensor, "4 sample"]
) -> Bilinear:
    """Return the published problem, without priors and robust weights, as a batch of one patch."""
    views = lights.new_zeros(1, len(lights))
    return Bilinear(
        radiance=matrix.radiance[None],
        weight=matrix.seen[None].to(matrix.radiance),
        lights=lights[None],
        anchor=lights[None],
        shading=shading[None],
        regularization=views,
    )


def solve_whole(
    matrix: Matrix,
    lights: Float[Tensor, "view 4"],
    shading: Float[Tensor, "4 sample"],
    max_iterations: int,
    tolerance: float,
    steps_before: int = 0,
) -> Whole:
    """Factorize by augmented Lagrangian, chunk by chunk.

    Step by step what :func:`~pimper_torch.photometry.balm.solve_balm` does with one patch.

    Args:
        matrix: ``J`` and ``D``.
        lights: Where they start; their size is kept, as the scale between albedo and light
            is free.
        shading: Where ``N`` starts, columns on the cone.
        max_iterations: Steps at most.
        tolerance: It is done when in one step neither ``N`` nor its distance from the cone
            changed or remained by more than this fraction of its length.
        steps_before: Taken on a part of the samples; the penalty goes on from there.
    """
    shading, multiplier = shading.clone(), torch.zeros_like(shading)
    count = matrix.seen.sum(dim=1).double()
    num_seen = max(int(matrix.seen.any(dim=0).sum()), 1)
    size = (lights**2).sum()
    for step in range(max_iterations):
        fraction = min(PENALTY_START * PENALTY_GROWTH ** (steps_before + step), PENALTY_CAP)
        # The mean trace of the samples' equations, without a walk through the samples.
        trace = (count * (lights.double() ** 2).sum(dim=1)).sum() / (4 * num_seen)
        packed = lights.new_zeros(1, 10, len(lights), dtype=torch.float64)
        rhs = lights.new_zeros(1, 4, len(lights), dtype=torch.float64)
        moved = difference = length = 0.0
        for part in chunks(shading.shape[1]):
            problem = as_problem(matrix.columns(part), lights, shading[:, part])
            A, b = equations_of_samples(problem, problem.lights, problem.weight)
            penalty = float(fraction * trace)
            A[:, diagonal(4)] += penalty
            old, dual = problem.shading, multiplier[None, :, part]
            free = solve_packed(A, b + penalty * (old - dual))
            new = project_to_cone((free + dual).mT).mT
            on_lights = equations_of_views(problem, free, problem.weight)
            packed, rhs = packed + on_lights[0], rhs + on_lights[1]
            moved += float((new - old).square().sum(dtype=torch.float64))
            difference += float((free - new).square().sum(dtype=torch.float64))
            length += float(new.square().sum(dtype=torch.float64))
            multiplier[:, part] = (dual + free - new)[0]
            shading[:, part] = new[0]
        lights = solve_packed(packed, rhs)[0].mT.to(lights)
        factor = (size / (lights**2).sum().clamp_min(1e-30)).sqrt()
        lights = lights * factor
        shading /= factor
        multiplier /= factor
        if max(moved, difference) <= tolerance**2 * length:
            return Whole(lights=lights, shading=shading, iterations=step + 1, converged=True)
    return Whole(lights=lights, shading=shading, iterations=max_iterations, converged=False)
