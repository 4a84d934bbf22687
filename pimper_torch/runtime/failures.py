"""Failures of a patch, view or solver, which is skipped and reported at the end of the run.

Only failures caused by data are skipped: numbers that are not finite, equations without a solution,
and unusable input of one patch or view. Other errors are bugs or a lack of memory, and end the run.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import groupby
from operator import attrgetter
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
from pimper_torch.runtime.events import Event, Failure, Removal
from pimper_torch.runtime.stream import Emit, collected, emit, listening

Result = TypeVar("Result")

# Torch's messages for failed allocations on the CPU; CUDA has its own error class.
_NO_MEMORY = ("can't allocate memory", "not enough memory", "out of memory")

_KIND = attrgetter("stage", "what", "done")


def _fatal(event: Event, outside: Emit) -> bool:
    if isinstance(event, Failure):
        raise ReconstructionError(
            f"{event.stage}: {event.what} {event.name} failed: {event.reason}. Failures end this "
            f"run (`on_failure` is fail); with skip it would continue: {event.done}."
        )
    return outside(event)


@contextmanager
def skipping(
    on_failure: OnFailure = "skip", entries: list[Event] | None = None
) -> Iterator[list[Event]]:
    """Collect the failures and the entries of guards in the ``with`` block.

    If the block raises an error, warnings of the earlier failures come first.

    Args:
        on_failure: ``"fail"`` raises an error instead of skipping.
        entries: Earlier entries, to which new ones are appended.

    Yields:
        The list of entries, for :func:`warn_of` at the end.

    Raises:
        OutOfMemoryError: Instead of other errors for failed allocations.
    """
    entries = [] if entries is None else entries
    fail = on_failure == "fail"
    policy: AbstractContextManager[None] = listening(_fatal) if fail else nullcontext()
    try:
        with collected(Failure, Removal, into=entries), policy:
            yield entries
    except BaseException as error:
        warn_of(entries)
        failed = isinstance(error, RuntimeError) and any(text in str(error) for text in _NO_MEMORY)
        if failed or isinstance(error, MemoryError | torch.OutOfMemoryError):
            raise OutOfMemoryError(
                f"Memory ran out: {reason_of(error)}. "
                "Shrink the photographs (`--max-size-px`), use fewer samples "
                "(`decompose.samples_per_pixel`), or close other programs."
            ) from error
        raise


def skipped(*failures: Failure) -> None:
    """Record failures that were skipped; outside of :func:`skipping`, warn immediately."""
    warn_of([failure for failure in failures if not emit(failure)])


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
    skipped(Failure(stage=stage, what="solver", name=name, reason=reason_of(error), done=done))


def failures_of(entries: Iterable[Event]) -> tuple[Failure, ...]:
    """Return the distinct failures, in an order that does not depend on threads."""
    return tuple(sorted({entry for entry in entries if isinstance(entry, Failure)}, key=_order))


def warn_of(entries: Iterable[Event]) -> None:
    """Warn once for each kind of failure, with the number and the first names."""
    for (stage, what, done), group in groupby(failures_of(entries), key=_KIND):
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


def _order(failure: Failure) -> tuple[object, ...]:
    number = int(failure.name) if failure.name.isdigit() else -1
    return (*_KIND(failure), number, failure.name, failure.reason)
