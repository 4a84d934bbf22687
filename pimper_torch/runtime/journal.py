"""The journal: messages during a call, and their listeners. Results do not depend on it.

The journal of a call, shared by its threads, receives cautions
(:mod:`~pimper_torch.runtime.errors`), failures (:mod:`~pimper_torch.runtime.failures`), entries of
guards (:mod:`~pimper_torch.runtime.ledger`), reports of stages
(:mod:`~pimper_torch.runtime.reporting`) and progress (:mod:`~pimper_torch.runtime.progress`).
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import Any

# Lines of a run's table outside of stages: hashing their inputs, writing and reading records.
HASH, KEEP = "hash", "keep"


@dataclass(frozen=True, slots=True, kw_only=True)
class Journal:
    """Events and listeners of a call.

    Attributes:
        events: Cautions (texts), failures, entries of guards, reports of stages; or ``None``.
        collects: Whether failures and entries of guards are events; else failures warn at once.
        fail: Whether a failure ends the run.
        quiet: Whether cautions are only events, without warnings.
        observer: Listener of stages; ``None`` within a stage, whose nested stages are not reported.
        figures: Figures of the running stage so far.
        began: Start of the stages, in seconds of :func:`time.perf_counter`.
        aside: Seconds outside of stages, by line.
        progress: Listener of the number of finished steps and of all steps.
        masks: Listener of the masks of guards.
        worker: Whether this thread is one of several, so that its calls must not start more.
    """

    events: list[object] | None = None
    collects: bool = False
    fail: bool = False
    quiet: bool = False
    observer: Any = None
    figures: dict[str, int | float] = field(default_factory=dict)
    began: float = 0.0
    aside: dict[str, float] = field(default_factory=dict)
    progress: Callable[[int, int], None] | None = None
    masks: Callable[..., None] | None = None
    worker: bool = False

    def so_far(self) -> list[object]:
        """Return the list of events; a new list if they are not collected."""
        return [] if self.events is None else self.events

    def note(self, event: object) -> None:
        """Add an event if events are collected."""
        if self.events is not None:
            self.events.append(event)


_current: ContextVar[Journal] = ContextVar("journal", default=Journal())  # noqa: B039


def current() -> Journal:
    """Return the journal of the current call in this thread."""
    return _current.get()


@contextmanager
def writing(journal: Journal) -> Iterator[Journal]:
    """Make a journal the current one inside the ``with`` block, including its threads."""
    token = _current.set(journal)
    try:
        yield journal
    finally:
        _current.reset(token)


@contextmanager
def noted() -> Iterator[list[object]]:
    """Copy the events of the ``with`` block; the current journal still receives them.

    Yields:
        A list, filled with the events at the end of the block.
    """
    copies, events = list[object](), current().so_far()
    before = len(events)
    with writing(replace(current(), events=events)):
        yield copies
    copies += events[before:]


@contextmanager
def aside(line: str) -> Iterator[None]:
    """Add the seconds of the ``with`` block to a line of the table, unless a stage is running."""
    journal, began = current(), time.perf_counter()
    yield
    if journal.observer is not None:
        journal.aside[line] = journal.aside.get(line, 0.0) + time.perf_counter() - began
