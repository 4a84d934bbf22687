"""The time left for a run, from what its stages took so far."""

import time
from collections.abc import Sequence

from pimper_torch.records import StageReport


class Forecast:
    """An observer that scales planned seconds by what stages took in this run.

    A stage that ran before, in an earlier pass, is scaled by itself; any other by all that ran, and
    by the one under way where it takes longer than planned.

    Attributes:
        plan: Stages to come, in order, with their seconds on some machine; may be empty.
    """

    def __init__(self) -> None:
        self.plan: Sequence[tuple[str, float]] = ()
        self._next = 0
        self._ended: list[tuple[str, float, float]] = []  # name, planned and real seconds
        self._began: float | None = None
        self._done = 0.0

    def started(self, stage: str) -> None:
        """Hear that a stage begins; those planned before it are not to come."""
        self._began, self._done = time.perf_counter(), 0.0
        names = [name for name, _ in self.plan[self._next :]]
        if stage in names:
            self._next += names.index(stage)

    def progressed(self, done: int, total: int) -> None:
        """Hear how far the stage is."""
        self._done = done / max(1, total)

    def finished(self, report: StageReport) -> None:
        """Hear that a stage ended, and what it took."""
        self._began = None
        name, seconds = next(iter(self.plan[self._next :]), ("", 0.0))
        if name == report.name:
            self._next += 1
            if not report.kept:
                self._ended.append((name, seconds, report.seconds))

    def seconds_left(self) -> float | None:
        """Estimate the seconds to the end; ``None`` where there is no plan."""
        if not self.plan:
            return None
        taken, passed = list(self._ended), 0.0
        if self._began is not None and self._next < len(self.plan):
            name, seconds = self.plan[self._next]
            passed = time.perf_counter() - self._began
            if passed > seconds:
                taken.append((name, seconds, passed))
        left = [seconds * self._factor(name, taken) for name, seconds in self.plan[self._next :]]
        if passed:
            share = self._done
            left[0] = (1 - share) * max(left[0], passed) if share else max(0.0, left[0] - passed)
        return sum(left, 0.0)

    def _factor(self, name: str, taken: Sequence[tuple[str, float, float]]) -> float:
        """Return real over planned seconds: of the pass before, or of all stages."""
        if own := [real / planned for one, planned, real in self._ended if one == name]:
            return own[-1]
        # Weight of the plan's own scale against the times of this machine so far.
        weight = 0.05 * sum(seconds for _, seconds in self.plan)
        planned = sum(seconds for _, seconds, _ in taken)
        return (weight + sum(real for *_, real in taken)) / (weight + planned)
