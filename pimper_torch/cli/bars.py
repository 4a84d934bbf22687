"""Display of a run's progress: a bar or lines on the terminal, or JSON events."""

import math
import time
from collections.abc import Callable

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from pimper_torch.cli.doctor.forecast import Forecast
from pimper_torch.records import StageReport

PHRASES = {
    "read": "reading photographs",
    "photographs": "reading photographs",
    "compile": "compiling, once",
    "reconstruct": "matching photographs",
    "depth_points": "estimating depth",
    "silhouettes": "finding silhouettes",
    "contours": "tracing outlines",
    "given_mesh": "fitting the given mesh",
    "coarse_surface": "making the coarse surface",
    "triangulate": "making the coarse surface",
    "preview": "drawing a preview",
    "view": "drawing a preview",
    "explain": "comparing with silhouettes",
    "pyramids": "shrinking photographs",
    "decompose": "placing facets",
    "warp": "sampling photographs",
    "light": "fitting light",
    "depth_from_light": "estimating depth from light",
    "photometry": "measuring normals and depth",
    "factorize": "measuring normals",
    "sweep": "measuring depth",
    "integrate": "integrating normals",
    "align": "aligning facets",
    "refine": "refining facets",
    "gauge": "matching facets' brightness",
    "fuse": "fusing the surface",
    "repair": "repairing folds",
    "remesh": "refining facets",
    "extract": "cutting out the mesh",
    "judge": "judging the result",
    "simplify": "simplifying the mesh",
    "relight": "fitting light and material",
    "texture": "making textures",
    "judge_textures": "predicting photographs",
    "draw": "drawing images",
    "scale": "finding the size",
    "write": "writing files",
}
"""Stages in plain words; others are displayed by name."""


class Bars(Forecast):
    """Observer that displays one bar for the run, its time left, and the stage in plain words.

    Without a terminal, it writes a line at the end of each stage, and per tenth of a long one.

    Args:
        figures: Whether the end of a stage is displayed with all figures, also on a terminal.
        seconds: Minimum time between lines within a stage; chosen by hand.
    """

    def __init__(self, console: Console, figures: bool = False, seconds: float = 10.0) -> None:
        super().__init__()
        self.console = console
        self._figures, self._seconds = figures, seconds
        self._tenths, self._last, self._stage = 0, 0.0, ""
        self._start, self._done = time.perf_counter(), 0.0
        self._live = Live(
            console=console, get_renderable=self._bar, refresh_per_second=4, transient=True
        )

    def __enter__(self) -> "Bars":
        if self.console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def started(self, stage: str) -> None:
        """Display a stage."""
        super().started(stage)
        self._tenths, self._last, self._stage = 0, time.perf_counter(), stage

    def progressed(self, done: int, total: int) -> None:
        """Advance the bar, or write a line."""
        super().progressed(done, total)
        tenths, now = 10 * done // total, time.perf_counter()
        due = self._tenths < tenths < 10 and now - self._last >= self._seconds
        if due and not self.console.is_terminal:
            self._tenths, self._last = tenths, now
            self._line(self._stage, f"{done / total:9.0%}")

    def finished(self, report: StageReport) -> None:
        """Write the time and the figures of a stage."""
        super().finished(report)
        self._last = math.inf  # late progress has no line
        if self._figures or not self.console.is_terminal:
            figures = report.figures if self._figures else {}
            text = [f"{name.replace('_', ' ')} {_short(each)}" for name, each in figures.items()]
            seconds = "     kept" if report.kept else f"{report.seconds:7.1f} s"
            self._line(report.name, "  ".join([seconds, ", ".join(text)]).rstrip())

    def _line(self, stage: str, text: str) -> None:
        left = f"  [{self._left()}]" if not self.console.is_terminal and self._left() else ""
        line = f"{stage:<12} {text}{left}"
        self.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _left(self) -> str:
        seconds = self.seconds_left()
        return "" if seconds is None else f"about {_time(seconds)} left"

    def _bar(self) -> Table:
        left, passed = self.seconds_left(), time.perf_counter() - self._start
        done = self._share
        if left is not None:
            done = self._done = max(self._done, passed / (passed + left))
        bar = ProgressBar(1.0, done, width=20, pulse=not done)
        row = Table.grid(padding=(0, 1))
        share = f"{done:4.0%}" if done else ""
        row.add_row(f"{PHRASES.get(self._stage, self._stage):<27}", bar, share, self._left())
        return row


def _short(value: float | int) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:,.3g}"


def _time(seconds: float) -> str:
    """Return a time left as text, in steps of at most a tenth of it."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.{int(seconds < 599)}f} minutes"


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
