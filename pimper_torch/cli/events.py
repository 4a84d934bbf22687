"""Progress of a run, as events for a machine."""

import time
from collections.abc import Callable

from pimper_torch.doctor.forecast import Forecast
from pimper_torch.records import StageReport


class Events:
    """An observer that writes when a stage begins, how far it is, and when it ends.

    Args:
        write: Called with every event's name, and what it is about by name.
        seconds: Progress is written no more often; its end always is.
    """

    def __init__(self, write: Callable[..., None], seconds: float, forecast: Forecast) -> None:
        self._write, self._forecast = write, forecast
        self._seconds = seconds
        self._stage = ""
        self._last = 0.0

    def started(self, stage: str) -> None:
        """Write that a stage begins."""
        self._stage, self._last = stage, time.perf_counter()
        self._forecast.started(stage)
        self._write("stage-begin", stage=stage, seconds_left=self._left())

    def progressed(self, done: int, total: int) -> None:
        """Write how far the stage is, unless that was written just now."""
        self._forecast.progressed(done, total)
        now = time.perf_counter()
        if now - self._last >= self._seconds or done == total:
            self._last = now
            left = self._left()
            self._write("progress", stage=self._stage, done=done, total=total, seconds_left=left)

    def finished(self, report: StageReport) -> None:
        """Write that the stage ended, what it cost and what it found."""
        self._forecast.finished(report)
        self._write(
            "stage-end",
            stage=report.name,
            seconds=round(report.seconds, 3),
            peak_memory_mb=round(report.peak_memory_mb, 1),
            figures=report.figures,
            kept=report.kept,
            seconds_left=self._left(),
        )

    def _left(self) -> float | None:
        seconds = self._forecast.seconds_left()
        return None if seconds is None else round(seconds, 1)
