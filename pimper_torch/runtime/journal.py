"""The journal: messages of a call while it works, and their listeners; no result depends on it.

Cautions (:mod:`~pimper_torch.runtime.errors`), failures (:mod:`~pimper_torch.runtime.failures`),
what guards leave out (:mod:`~pimper_torch.runtime.ledger`), reports of stages
(:mod:`~pimper_torch.runtime.reporting`) and progress (:mod:`~pimper_torch.runtime.progress`) are
told to the journal of the call, in threads of it, too.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import Any

# Lines of a run's table for what no stage does: hashes of what stages are called with, and records
# written and read.
HASH, KEEP = "hash", "keep"


@dataclass(frozen=True, slots=True, kw_only=True)
class Journal:
    """Who hears of what.

    Attributes:
        events: Cautions (texts), failures, entries of guards, and reports of stages, as they come;
            ``None`` where nobody collects them.
        collects: Whether failures and entries of guards are events; else failures are warned of at
            once.
        fail: Whether a failure ends the run.
        quiet: Whether cautions are events alone, and no warnings.
        observer: Hears of stages; ``None`` within a stage, whose parts are no stages.
        figures: Of the stage that runs, so far.
        began: When the stages began, as :func:`time.perf_counter` counts.
        aside: Seconds by line of what no stage does.
        progress: Hears how many steps of how many are done.
        masks: Hears of the masks of guards.
        worker: Whether this thread is one of several: what it calls runs in it alone.
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
        """Return the list of events; a new one where nobody collects them."""
        return [] if self.events is None else self.events

    def note(self, event: object) -> None:
        """Add an event, if anybody collects them."""
        if self.events is not None:
            self.events.append(event)


_current: ContextVar[Journal] = ContextVar("journal", default=Journal())  # noqa: B039


def current() -> Journal:
    """Return the journal of the call that this thread is in."""
    return _current.get()


@contextmanager
def writing(journal: Journal) -> Iterator[Journal]:
    """Write to another journal inside the ``with`` block, in threads of it, too."""
    token = _current.set(journal)
    try:
        yield journal
    finally:
        _current.reset(token)


@contextmanager
def noted() -> Iterator[list[object]]:
    """Note what is told inside the ``with`` block; it is told all the same.

    Yields:
        The list that holds the events when the block has ended.
    """
    found, events = list[object](), current().so_far()
    before = len(events)
    with writing(replace(current(), events=events)):
        yield found
    found += events[before:]


@contextmanager
def aside(line: str) -> Iterator[None]:
    """Count what the ``with`` block takes to a line of its own, unless a stage is under way."""
    journal, began = current(), time.perf_counter()
    yield
    if journal.observer is not None:
        journal.aside[line] = journal.aside.get(line, 0.0) + time.perf_counter() - began
