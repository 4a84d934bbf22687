"""Stage reports: time, memory, and figures of the returned record."""

import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from threading import Lock
from typing import Protocol, runtime_checkable

from pimper_torch.runtime.events import StageReport
from pimper_torch.runtime.journal import HASH, KEEP, Journal, current, writing

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


# Line of a run's table for the time outside of stages and of its other lines.
BETWEEN = "between stages"
ASIDE = HASH, KEEP, BETWEEN


def reported(
    name: str, seconds: float, figures: dict[str, int | float] | None = None
) -> StageReport:
    """Return the report of a stage or line that has just ended."""
    return StageReport(
        name=name, seconds=seconds, peak_memory_mb=peak_memory_mb(), figures=figures or {}
    )


def seconds_of(reports: Iterable[StageReport]) -> float:
    """Return the seconds of all stages in this run; stages with kept records ran earlier."""
    return sum(report.seconds for report in reports if not report.kept)


def gathered(reports: Sequence[StageReport]) -> tuple[StageReport, ...]:
    """Return the reports with the lines outside of stages added up, at the end."""
    groups = [[report for report in reports if report.name == name] for name in ASIDE]
    lines = [group[-1].replace(seconds=seconds_of(group)) for group in groups if group]
    return (*(report for report in reports if report.name not in ASIDE), *lines)


@contextmanager
def recorded(observer: Observer) -> Iterator[list[StageReport]]:
    """Collect the reports of the stages in the ``with`` block; see :func:`stage`.

    A nested block outside of a stage is part of the outer block.

    Yields:
        A list, filled at the end of the block with the reports, and those of lines outside stages.
    """
    events, reports = current().so_far(), list[StageReport]()
    before = len(events)
    journal = replace(
        current(),
        events=events,
        observer=observer,
        progress=observer.progressed,
        began=time.perf_counter(),
        aside={},
    )
    with writing(journal):
        yield reports
    stages = _reports(events[before:])
    reports += _lines(journal, stages)
    events += reports[len(stages) :]


def accounted() -> tuple[StageReport, ...]:
    """Return all lines of the call so far; their seconds add up to those of the call."""
    journal = current()
    return () if journal.observer is None else gathered(_lines(journal, journal.so_far()))


def _reports(events: Iterable[object]) -> list[StageReport]:
    return [event for event in events if isinstance(event, StageReport)]


def _lines(journal: Journal, events: Iterable[object]) -> list[StageReport]:
    """Return the reports and the lines outside of stages; they add up to the call's seconds."""
    lines = [*_reports(events), *(reported(name, time) for name, time in journal.aside.items())]
    rest = time.perf_counter() - journal.began - seconds_of(lines)
    return [*lines, reported(BETWEEN, rest)]


@contextmanager
def stage(name: str) -> Iterator[dict[str, int | float]]:
    """Report the ``with`` block as one stage; stages that it calls are not reported.

    Yields:
        The figures of the report, for the caller to fill.
    """
    metrics: dict[str, int | float] = {}
    journal, began = current(), time.perf_counter()
    if journal.observer is None:
        yield metrics
        return
    events = journal.so_far()
    before = len(events)
    journal.observer.started(name)
    with writing(replace(journal, observer=None, figures=metrics)):
        yield metrics
    report = reported(name, time.perf_counter() - began, metrics)
    events[before:] = [event for event in events[before:] if not isinstance(event, StageReport)]
    events.append(report)
    journal.observer.finished(report)


@contextmanager
def part(name: str) -> Iterator[None]:
    """Add the seconds of the ``with`` block to the figures of its stage, from any thread."""
    began = time.perf_counter()
    yield
    add_counts({f"{name}_seconds": time.perf_counter() - began})


def add_counts(counts: Mapping[str, int | float]) -> None:
    """Add counts to the figures of the running stage, from any thread."""
    metrics = current().figures
    with _counting:
        for name, count in counts.items():
            metrics[name] = metrics.get(name, 0) + count


def peak_memory_mb() -> float:
    """Return the peak resident memory of this process so far, in MB; 0 on Windows."""
    if sys.platform == "win32":
        return 0.0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)  # bytes there, kilobytes here
