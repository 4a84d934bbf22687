"""A solver's loop over a batch of problems, which stop one by one."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.photometry.bilinear import Bilinear, Factors, to_factors
from pimper_torch.records import Record, StopCause

# In place of a cause, for a patch that has not stopped.
RUNNING = -1

# Patches that have stopped leave the batch when they are this fraction of it: a choice, as
# copying the rest costs about a step.
_COMPACT_FRACTION = 0.25


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class State(Record):
    """State that every solver iterates; the first axis is the patch.

    Attributes:
        lights: ``L``.
        shading: ``N``, columns on the manifold.
        weight: Of each entry, robust weights included.
    """

    lights: Float[Tensor, "patch view rank"]
    shading: Float[Tensor, "patch rank sample"]
    weight: Float[Tensor, "patch view sample"]


AnyState = TypeVar("AnyState", bound=State)


def iterate(
    problem: Bilinear,
    state: AnyState,
    advance: Callable[[Bilinear, AnyState, int], tuple[AnyState, Int[Tensor, " patch"]]],
    max_iterations: int,
) -> Factors:
    """Iterate until every patch has stopped; those that have leave the batch.

    Args:
        advance: One step of the remaining patches: from problem, state and index of the step
            to the next state and, for each patch, a :class:`StopCause` or ``RUNNING``.

    Returns:
        Every patch's last lights, shading and weights, its number of steps, and its stop cause.
    """
    whole = problem
    patches = torch.arange(len(problem.radiance), device=problem.radiance.device)
    taken = torch.full_like(patches, max_iterations)
    causes = torch.full_like(patches, int(StopCause.LIMIT))
    running = torch.ones_like(patches, dtype=torch.bool)
    names = [field.name for field in dataclasses.fields(state)]
    final = state.replace(**{name: getattr(state, name).clone() for name in names})
    for step in range(max_iterations):
        state, cause = advance(problem, state, step)
        ended = running & (cause != RUNNING)
        _store(final, state, names, patches, ended)
        taken[patches[ended]] = step + 1
        causes[patches[ended]] = cause[ended]
        running = running & ~ended
        if not bool(running.any()):
            break
        if float((~running).double().mean()) >= _COMPACT_FRACTION:
            keep = running.nonzero()[:, 0]
            state, problem, patches = state.take(keep), problem.take(keep), patches[keep]
            running = running[keep]
    _store(final, state, names, patches, running)
    return to_factors(whole, final.lights, final.shading, final.weight, taken, causes)


def _store(
    final: Record, state: Record, names: list[str], patches: Int[Tensor, " patch"], rows: Tensor
) -> None:
    for name in names:
        getattr(final, name)[patches[rows]] = getattr(state, name)[rows]
