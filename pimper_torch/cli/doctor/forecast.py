"""Time left for a run, from planned and measured times of its stages."""

import time
from collections.abc import Sequence

from pimper_torch.records import StageReport


class Forecast:
    """Observer that scales planned seconds by measured ones, and displays nothing.

    A stage that ran in an earlier pass is scaled by its own time; other stages by the time of all
    that ran, and of the running stage if it takes longer than planned.

    Attributes:
        plan: Stages in order with planned seconds, from any machine; may be empty.
    """

    def __init__(self) -> None:
        self.plan: Sequence[tuple[str, float]] = ()
        self._next = 0
        self._ended: list[tuple[str, float, float]] = []  # name, planned and real seconds
        self._began: float | None = None
        self._done = 0.0

    def started(self, stage: str) -> None:
        """Record the start of a stage; stages planned before it are skipped."""
        self._began, self._done = time.perf_counter(), 0.0
        names = [name for name, _ in self.plan[self._next :]]
        if stage in names:
            self._next += names.index(stage)

    def progressed(self, done: int, total: int) -> None:
        """Record the progress of the stage."""
        self._done = done / max(1, total)

    def finished(self, report: StageReport) -> None:
        """Record the time of a finished stage."""
        self._began = None
        name, seconds = next(iter(self.plan[self._next :]), ("", 0.0))
        if name == report.name:
            self._next += 1
            if not report.kept:
                self._ended.append((name, seconds, report.seconds))

    def seconds_left(self) -> float | None:
        """Estimate the seconds to the end of the run; ``None`` without a plan."""
        if not self.plan:
            return None
        times, passed = list(self._ended), 0.0
        if self._began is not None and self._next < len(self.plan):
            name, seconds = self.plan[self._next]
            passed = time.perf_counter() - self._began
            if passed > seconds:
                times.append((name, seconds, passed))
        left = [seconds * self._factor(name, times) for name, seconds in self.plan[self._next :]]
        if passed:
            share = self._done
            left[0] = (1 - share) * max(left[0], passed) if share else max(0.0, left[0] - passed)
        return sum(left, 0.0)

    def _factor(self, name: str, times: Sequence[tuple[str, float, float]]) -> float:
        """Return measured over planned seconds: of the stage's last pass, or of all stages."""
        if ratios := [real / planned for stage, planned, real in self._ended if stage == name]:
            return ratios[-1]
        # Weight of the planned times against those measured so far.
        weight = 0.05 * sum(seconds for _, seconds in self.plan)
        planned = sum(seconds for _, seconds, _ in times)
        return (weight + sum(real for *_, real in times)) / (weight + planned)
