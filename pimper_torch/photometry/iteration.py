"""A solver's loop over a batch of problems, which stop one by one."""

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import torch
from jaxtyping import Int
from torch import Tensor

from pimper_torch.photometry.bilinear import Bilinear
from pimper_torch.records import Record, StopCause

State = TypeVar("State", bound=Record)

# In place of a cause, for a patch that has not stopped.
RUNNING = -1

# Patches that have stopped leave the batch when they are this fraction of it: a choice, as
# copying the rest costs about a step.
_COMPACT_FRACTION = 0.25


def iterate(
    problem: Bilinear,
    state: State,
    advance: Callable[[Bilinear, State, int], tuple[State, Int[Tensor, " patch"]]],
    max_iterations: int,
) -> tuple[State, Int[Tensor, " patch"], Int[Tensor, " patch"]]:
    """Iterate until every patch has stopped; those that have leave the batch.

    Args:
        problem: All patches.
        state: The initial state; the first axis of all its tensors is the patch.
        advance: One step of the remaining patches: from problem, state and index of the step
            to the next state and, for each patch, a :class:`StopCause` or ``RUNNING``.
        max_iterations: Steps at most.

    Returns:
        Every patch's last state, its number of steps, and its stop cause.
    """
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
            return final, taken, causes
        if float((~running).double().mean()) >= _COMPACT_FRACTION:
            keep = running.nonzero()[:, 0]
            state, problem, patches = state.take(keep), problem.take(keep), patches[keep]
            running = running[keep]
    _store(final, state, names, patches, running)
    return final, taken, causes


def _store(
    final: Record, state: Record, names: list[str], patches: Int[Tensor, " patch"], rows: Tensor
) -> None:
    for name in names:
        getattr(final, name)[patches[rows]] = getattr(state, name)[rows]
