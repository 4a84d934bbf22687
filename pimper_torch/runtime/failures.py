"""One bad patch, view or solver does not end a run: it is left out, and told at the end.

Only what data can cause is left out: numbers that are not finite, equations without a solution, and
input of one part that cannot be used. Other errors are mistakes in a program, or a lack of memory,
and end the run.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import groupby
from typing import TypeVar

import torch
from jaxtyping import Int

from pimper_torch.records.reconstruction import Failure, LeftOut
from pimper_torch.runtime.errors import (
    NumericalError,
    OnFailure,
    OutOfMemoryError,
    ReconstructionError,
    caution,
)
from pimper_torch.runtime.journal import current, writing

Result = TypeVar("Result")

# What torch says when an allocation fails on the CPU; CUDA's error has a class of its own.
_NO_MEMORY = ("can't allocate memory", "not enough memory", "out of memory")


@contextmanager
def collecting(
    on_failure: OnFailure = "skip", events: list[object] | None = None
) -> Iterator[list[object]]:
    """Collect what is told inside the ``with`` block: what is skipped, left out, and so on.

    Where the block ends in an error, what was skipped before is told first.

    Args:
        on_failure: ``"fail"`` refuses instead of skipping.
        events: Those so far, which more are added to.

    Yields:
        The events so far, for :func:`warn_of` at the end.

    Raises:
        OutOfMemoryError: In place of an error of memory.
    """
    outer, events = current(), [] if events is None else events
    before, fail = len(events), on_failure == "fail"
    try:
        with writing(replace(outer, events=events, collects=True, fail=fail)):
            yield events
    except BaseException as error:
        warn_of(events)
        failed = isinstance(error, RuntimeError) and any(one in str(error) for one in _NO_MEMORY)
        if failed or isinstance(error, MemoryError | torch.OutOfMemoryError):
            raise OutOfMemoryError(
                f"Memory did not suffice: {reason_of(error)}. "
                "Shrink the photographs (`--max-size-px`), take fewer samples "
                "(`decompose.samples_per_pixel`), or close other programs."
            ) from error
        raise
    for event in events[before:]:
        if not isinstance(event, Failure | LeftOut):
            outer.note(event)


def skipped(*failures: Failure, error: BaseException | None = None) -> None:
    """Note what failed and was left out; outside of :func:`collecting`, warn of it at once.

    Raises:
        ReconstructionError: Failures are to end the run.
    """
    journal = current()
    if failures and journal.fail:
        first = failures[0]
        raise ReconstructionError(
            f"{first.stage}: {first.what} {first.name} failed: {first.reason}. Failures are to end "
            f"the run (`on_failure` is fail); with skip it goes on: {first.done}."
        ) from error
    if not journal.collects:
        warn_of(failures)
        return
    for failure in failures:
        journal.note(failure)


def skipped_patches(
    stage: str, facets: Int[torch.Tensor, " patch"], reason: str, done: str
) -> None:
    """Note patches that were left out; see :func:`skipped`."""
    skipped(
        *(
            Failure(stage=stage, what="patch", name=str(facet), reason=reason, done=done)
            for facet in facets.tolist()
        )
    )


def skipped_solver(stage: str, name: str, error: BaseException, done: str) -> None:
    """Note equations without a solution; see :func:`skipped`."""
    reason = reason_of(error)
    skipped(Failure(stage=stage, what="solver", name=name, reason=reason, done=done), error=error)


def distinct(entries: Sequence[object]) -> tuple[Failure, ...]:
    """List each failure once, in an order that threads do not change."""
    return tuple(sorted({one for one in entries if isinstance(one, Failure)}, key=_order))


def warn_of(entries: Sequence[object]) -> None:
    """Warn once of each kind of failure, with how many there are and the first of them."""
    for (stage, what, done), some in groupby(distinct(entries), key=_kind):
        kind = list(some)
        names = list(dict.fromkeys(failure.name for failure in kind))
        listed = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        caution(
            f"{stage}: {len(names)} failed ({what} {listed}): {kind[0].reason}. {done}. "
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
    """Solve, or give something else where equations have no solution.

    Args:
        otherwise: Gives what stands in for the solution.
    """
    try:
        return solve()
    except NumericalError as error:
        skipped_solver(stage, name, error, done)
    return otherwise()


def reason_of(error: BaseException) -> str:
    """Return an error in a line."""
    text = " ".join(str(error).split()).rstrip(".")
    return f"{type(error).__name__.lstrip('_')}: {text}" if text else type(error).__name__


def _kind(failure: Failure) -> tuple[str, str, str]:
    return failure.stage, failure.what, failure.done


def _order(failure: Failure) -> tuple[object, ...]:
    number = int(failure.name) if failure.name.isdigit() else -1
    return (*_kind(failure), number, failure.name, failure.reason)
