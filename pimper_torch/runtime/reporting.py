"""Stage reports: time, memory, and figures of the returned record."""

import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Lock
from typing import Protocol, runtime_checkable

from pimper_torch.runtime.events import Counts, Event, Progress, StageReport, StageStarted
from pimper_torch.runtime.stream import Emit, emit, listening

# Lines of a run's table for the time outside of stages: hashing their inputs, writing and reading
# records, and the rest.
HASH, KEEP, BETWEEN = "hash", "keep", "between stages"
ASIDE = HASH, KEEP, BETWEEN

_counting = Lock()


@runtime_checkable
class Observer(Protocol):
    """Receiver of the progress of a run, for display."""

    def started(self, stage: str) -> None:
        """Receive the name of a stage that starts."""

    def progressed(self, done: int, total: int) -> None:
        """Receive the number of finished batches of the stage."""

    def finished(self, report: StageReport) -> None:
        """Receive the report of a finished stage: its cost and figures."""


class SilentObserver:
    """Observer that ignores everything."""

    def _hear(self, *_: object, **__: object) -> None:
        pass

    started = progressed = finished = _hear


def stage_report(
    name: str, seconds: float, figures: dict[str, int | float] | None = None
) -> StageReport:
    """Return the report of a stage or line that has just ended."""
    return StageReport(
        name=name, seconds=seconds, peak_memory_mb=peak_memory_mb(), figures=figures or {}
    )


def seconds_of(reports: Iterable[StageReport]) -> float:
    """Return the seconds of all stages in this run; stages with kept records ran earlier."""
    return sum((report.seconds for report in reports if not report.kept), 0.0)


def table_of(reports: Sequence[StageReport]) -> tuple[StageReport, ...]:
    """Return the reports with the lines outside of stages added up, at the end."""
    groups = [[report for report in reports if report.name == name] for name in ASIDE]
    lines = [group[-1].replace(seconds=seconds_of(group)) for group in groups if group]
    return (*(report for report in reports if report.name not in ASIDE), *lines)


@dataclass(slots=True, kw_only=True)
class RunTable:
    """Reports of the stages of a ``with`` block, and of lines outside of them.

    Attributes:
        observer: Receives the stages, except those of a nested block with its own observer.
        began: Start of the block, in seconds of :func:`time.perf_counter`.
        running: Names of stages that the observer received and that have not finished.
    """

    observer: Observer
    began: float
    reports: list[StageReport] = field(default_factory=list)
    running: list[str] = field(default_factory=list)

    def hear(self, event: Event, outside: Emit) -> bool:
        """Tell the observer of an event, and add a report."""
        if isinstance(event, StageStarted):
            self.running.append(event.name)
            self.observer.started(event.name)
        elif isinstance(event, Progress):
            self.observer.progressed(event.done, event.total)
        elif isinstance(event, StageReport):
            self.reports.append(event)
            if event.name in self.running:
                self.running.remove(event.name)
                self.observer.finished(event)
            outside(event)
        else:
            return outside(event)
        return True

    def between(self) -> StageReport:
        """Return the line of the seconds so far that no other line accounts for."""
        seconds = time.perf_counter() - self.began - seconds_of(self.reports)
        return stage_report(BETWEEN, seconds)

    def so_far(self) -> tuple[StageReport, ...]:
        """Return the lines within the block; their seconds add up to those of the block so far."""
        return table_of([*self.reports, self.between()])


@contextmanager
def observed(observer: Observer) -> Iterator[RunTable]:
    """Show the stages in the ``with`` block to an observer; see :func:`stage`.

    A nested block outside of a stage is part of the outer block.

    Yields:
        The table of the block's reports, which is complete at the end of the block.
    """
    table = RunTable(observer=observer, began=time.perf_counter())
    with listening(table.hear):
        yield table
        emit(table.between())


@contextmanager
def stage(name: str) -> Iterator[dict[str, int | float]]:
    """Report the ``with`` block as one stage; stages that it calls are not reported.

    Yields:
        The figures of the report, for the caller to fill.
    """
    figures: dict[str, int | float] = {}
    began = time.perf_counter()

    def within(event: Event, outside: Emit) -> bool:
        if isinstance(event, StageStarted | StageReport):
            return False
        if not isinstance(event, Counts):
            return outside(event)
        with _counting:
            for key, count in event.counts.items():
                figures[key] = figures.get(key, 0) + count
        return True

    if not emit(StageStarted(name=name)):
        yield figures
        return
    with listening(within):
        yield figures
    emit(stage_report(name, time.perf_counter() - began, figures))


@contextmanager
def aside(line: str) -> Iterator[None]:
    """Add the seconds of the ``with`` block to a line of the table, unless a stage is running."""
    began = time.perf_counter()
    yield
    emit(stage_report(line, time.perf_counter() - began))


@contextmanager
def timed(name: str) -> Iterator[None]:
    """Add the seconds of the ``with`` block to the figures of its stage, from any thread."""
    began = time.perf_counter()
    yield
    add_counts({f"{name}_seconds": time.perf_counter() - began})


def add_counts(counts: Mapping[str, int | float]) -> None:
    """Add counts to the figures of the running stage, from any thread."""
    emit(Counts(counts=counts))


def peak_memory_mb() -> float:
    """Return the peak resident memory of this process so far, in MB; 0 on Windows."""
    if sys.platform == "win32":
        return 0.0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)  # bytes there, kilobytes here
