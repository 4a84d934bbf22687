"""Failures of a patch, view or solver, which is skipped and reported at the end of the run.

Only failures caused by data are skipped: numbers that are not finite, equations without a solution,
and unusable input of one patch or view. Other errors are bugs or a lack of memory, and end the run.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import groupby
from typing import TypeVar

import torch
from jaxtyping import Int

from pimper_torch.runtime.errors import (
    NumericalError,
    OnFailure,
    OutOfMemoryError,
    ReconstructionError,
    caution,
)
from pimper_torch.runtime.events import Failure, Removal
from pimper_torch.runtime.journal import current, writing

Result = TypeVar("Result")

# Torch's messages for failed allocations on the CPU; CUDA has its own error class.
_NO_MEMORY = ("can't allocate memory", "not enough memory", "out of memory")


@contextmanager
def collecting(
    on_failure: OnFailure = "skip", events: list[object] | None = None
) -> Iterator[list[object]]:
    """Collect the events of the ``with`` block, such as failures and entries of guards.

    If the block raises an error, warnings of the earlier failures come first.

    Args:
        on_failure: ``"fail"`` raises an error instead of skipping.
        events: Earlier events, to which new ones are appended.

    Yields:
        The list of events, for :func:`warn_of` at the end.

    Raises:
        OutOfMemoryError: Instead of other errors for failed allocations.
    """
    outer, events = current(), [] if events is None else events
    before, fail = len(events), on_failure == "fail"
    try:
        with writing(replace(outer, events=events, collects=True, fail=fail)):
            yield events
    except BaseException as error:
        warn_of(events)
        failed = isinstance(error, RuntimeError) and any(text in str(error) for text in _NO_MEMORY)
        if failed or isinstance(error, MemoryError | torch.OutOfMemoryError):
            raise OutOfMemoryError(
                f"Memory ran out: {reason_of(error)}. "
                "Shrink the photographs (`--max-size-px`), use fewer samples "
                "(`decompose.samples_per_pixel`), or close other programs."
            ) from error
        raise
    for event in events[before:]:
        if not isinstance(event, Failure | Removal):
            outer.note(event)


def skipped(*failures: Failure, error: BaseException | None = None) -> None:
    """Record failures that were skipped; outside of :func:`collecting`, warn immediately.

    Raises:
        ReconstructionError: The journal requires that failures end the run.
    """
    journal = current()
    if failures and journal.fail:
        first = failures[0]
        raise ReconstructionError(
            f"{first.stage}: {first.what} {first.name} failed: {first.reason}. Failures end this "
            f"run (`on_failure` is fail); with skip it would continue: {first.done}."
        ) from error
    if not journal.collects:
        warn_of(failures)
        return
    for failure in failures:
        journal.note(failure)


def skipped_patches(
    stage: str, facets: Int[torch.Tensor, " patch"], reason: str, done: str
) -> None:
    """Record skipped patches; see :func:`skipped`."""
    skipped(
        *(
            Failure(stage=stage, what="patch", name=str(facet), reason=reason, done=done)
            for facet in facets.tolist()
        )
    )


def skipped_solver(stage: str, name: str, error: BaseException, done: str) -> None:
    """Record equations without a solution; see :func:`skipped`."""
    reason = reason_of(error)
    skipped(Failure(stage=stage, what="solver", name=name, reason=reason, done=done), error=error)


def distinct(entries: Sequence[object]) -> tuple[Failure, ...]:
    """Return the distinct failures, in an order that does not depend on threads."""
    return tuple(sorted({event for event in entries if isinstance(event, Failure)}, key=_order))


def warn_of(entries: Sequence[object]) -> None:
    """Warn once for each kind of failure, with the number and the first names."""
    for (stage, what, done), group in groupby(distinct(entries), key=_kind):
        failures = list(group)
        names = list(dict.fromkeys(failure.name for failure in failures))
        listed = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        caution(
            f"{stage}: {len(names)} failed ({what} {listed}): {failures[0].reason}. {done}. "
            "`failures` in summary.json lists all; `--on-failure fail` ends the run instead.",
            stacklevel=3,
        )


def solved_or(
    solve: Callable[[], Result],
    otherwise: Callable[[], Result],
    *,
    stage: str,
    name: str,
    done: str,
) -> Result:
    """Return the solution, or the result of ``otherwise`` if equations have no solution."""
    try:
        return solve()
    except NumericalError as error:
        skipped_solver(stage, name, error, done)
    return otherwise()


def reason_of(error: BaseException) -> str:
    """Return an error as one line of text."""
    text = " ".join(str(error).split()).rstrip(".")
    return f"{type(error).__name__.lstrip('_')}: {text}" if text else type(error).__name__


def _kind(failure: Failure) -> tuple[str, str, str]:
    return failure.stage, failure.what, failure.done


def _order(failure: Failure) -> tuple[object, ...]:
    number = int(failure.name) if failure.name.isdigit() else -1
    return (*_kind(failure), number, failure.name, failure.reason)
