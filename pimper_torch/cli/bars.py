"""Display of a run's progress: bars or lines on the terminal, or JSON events."""

import time
from collections.abc import Callable

from rich import progress
from rich.console import Console

from pimper_torch.cli.doctor.cost import minutes
from pimper_torch.cli.doctor.forecast import Forecast
from pimper_torch.records import StageReport


class Bars(Forecast):
    """Observer that displays a bar for every stage, and the time left for the run.

    Without a terminal, it writes a line at the end of each stage, and per tenth of a long one.

    Args:
        figures: Number of displayed figures of a finished stage; ``None`` for all.
        seconds: Minimum time between lines within a stage; chosen by hand.
    """

    def __init__(self, console: Console, figures: int | None = 3, seconds: float = 10.0) -> None:
        super().__init__()
        self.console = console
        self._most, self._seconds = figures, seconds
        self._tenths, self._last = 0, 0.0
        self._progress = progress.Progress(
            progress.TextColumn("{task.description:<12}"),
            progress.BarColumn(),
            progress.TaskProgressColumn(),
            progress.TimeElapsedColumn(),
            progress.TextColumn("[dim]{task.fields[text]}"),
            console=console,
            disable=not console.is_terminal,
        )
        self._task: progress.TaskID | None = None

    def __enter__(self) -> "Bars":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def started(self, stage: str) -> None:
        """Start a bar; it pulses until the stage reports progress."""
        super().started(stage)
        self._tenths, self._last = 0, time.perf_counter()
        self._task = self._progress.add_task(stage, total=None, text=self._left())

    def progressed(self, done: int, total: int) -> None:
        """Advance the bar, or write a line."""
        if self._task is None:
            return
        super().progressed(done, total)
        self._progress.update(self._task, completed=done, total=total, text=self._left())
        tenths, now = 10 * done // total, time.perf_counter()
        if self._tenths < tenths < 10 and now - self._last >= self._seconds:
            self._tenths, self._last = tenths, now
            self._line(self._progress.tasks[self._task].description, f"{done / total:9.0%}")

    def finished(self, report: StageReport) -> None:
        """Complete the bar, and display figures of the stage."""
        super().finished(report)
        figures = list(report.figures.items())[: self._most]
        text = ", ".join(f"{name.replace('_', ' ')} {_short(value)}" for name, value in figures)
        if self._task is not None:
            self._progress.update(self._task, completed=1, total=1, text=text)
        seconds = "     kept" if report.kept else f"{report.seconds:7.1f} s"
        self._line(report.name, f"{seconds}  {text}")
        self._task = None

    def _line(self, stage: str, text: str) -> None:
        if not self.console.is_terminal:
            left = f"  [{self._left()}]" if self._left() else ""
            line = f"{stage:<12} {text}{left}"
            self.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _left(self) -> str:
        seconds = self.seconds_left()
        return "" if seconds is None else f"about {minutes(seconds)} left"


def _short(value: float | int) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:,.3g}"


class Events(Forecast):
    """Observer that writes the start, progress and end of stages as events.

    Args:
        write: Called with the name of the event and its data as keywords.
        seconds: Minimum time between progress events; the last one is always written.
    """

    def __init__(self, write: Callable[..., None], seconds: float) -> None:
        super().__init__()
        self._write, self._seconds = write, seconds
        self._stage, self._last = "", 0.0

    def started(self, stage: str) -> None:
        """Write the start of a stage."""
        self._stage, self._last = stage, time.perf_counter()
        super().started(stage)
        self._event("stage-begin", stage=stage)

    def progressed(self, done: int, total: int) -> None:
        """Write the progress of the stage, at most once per interval."""
        super().progressed(done, total)
        now = time.perf_counter()
        if now - self._last >= self._seconds or done == total:
            self._last = now
            self._event("progress", stage=self._stage, done=done, total=total)

    def finished(self, report: StageReport) -> None:
        """Write the end of the stage with its cost and figures."""
        super().finished(report)
        self._event(
            "stage-end",
            stage=report.name,
            seconds=round(report.seconds, 3),
            peak_memory_mb=round(report.peak_memory_mb, 1),
            figures=report.figures,
            kept=report.kept,
        )

    def _event(self, event: str, **about: object) -> None:
        left = self.seconds_left()
        self._write(event, **about, seconds_left=None if left is None else round(left, 1))
