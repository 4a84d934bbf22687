"""Time left for a run, from planned and measured times of its stages."""

import math
import time
from collections.abc import Sequence

from pimper_torch.records import StageReport

# Chosen on recorded runs (tests/doctor/test_forecast.py). Besides the passing of time, the estimate
# changes by at most this factor in a period.
_CHANGE, _PERIOD_SECONDS = 1.2, 10.0
# Weights of the plan against measured times: in roots of seconds, and in seconds of a stage.
_TRUST, _OWN_SECONDS = 3.0, 2.0
# A stage that ran before, and is farther ahead in the plan, is repeated within its pass.
_SKIPPED = 2


class Forecast:
    """Observer that scales planned seconds by measured ones, and displays nothing.

    A stage that ran in an earlier pass is scaled mostly by its own time; other stages by the mean
    ratio of measured to planned times, in which a long stage counts less than its share of time.
    """

    def __init__(self) -> None:
        self.expect(())

    def expect(self, plan: Sequence[tuple[str, float]]) -> None:
        """Begin a run: its stages in order, with seconds planned for any machine."""
        self._plan, self._next = plan, 0
        self._ended: list[tuple[str, float, float]] = []  # name, planned and real seconds
        self._began: float | None = None  # if the running stage is planned
        self._share, self._shown, self._shown_at = 0.0, math.inf, 0.0

    def started(self, stage: str) -> None:
        """Record the start of a stage; stages planned before it are skipped."""
        names = [name for name, _ in self._plan]
        names, before = names[self._next :], names[: self._next]
        if stage in before:
            names = names[: 1 + _SKIPPED]
        for _ in range(names.index(stage) if stage in names else 0):
            self._skip()
        self._began = time.perf_counter() if stage in names else None
        self._share = 0.0

    def progressed(self, done: int, total: int) -> None:
        """Record the progress of the stage."""
        self._share = done / max(1, total)

    def finished(self, report: StageReport) -> None:
        """Record the time of a finished stage."""
        self._began = None
        name, seconds = next(iter(self._plan[self._next :]), ("", 0.0))
        if name == report.name and report.kept:
            self._skip()
        elif name == report.name:
            self._next += 1
            self._ended.append((name, seconds, report.seconds))

    def seconds_left(self) -> float | None:
        """Estimate the seconds to the end of the run, without jumps; ``None`` without a plan."""
        if not self._plan:
            return None
        now = time.perf_counter()
        passed, self._shown_at = now - self._shown_at, now
        estimate = self._estimate(now)
        if estimate and self._shown < math.inf:
            change = _CHANGE ** min(1.0, passed / _PERIOD_SECONDS)
            least = max(1.0, self._shown - passed) / change**2
            estimate = min(max(estimate, least), max(1.0, self._shown) * change)
        self._shown = estimate
        return estimate

    def _skip(self) -> None:
        """Take the next stage, which takes no time, from the time left."""
        self._shown -= _expected(self._plan[self._next], self._ended)
        self._next += 1

    def _estimate(self, now: float) -> float:
        left, times = self._plan[self._next :], self._ended
        if self._began is None or not left:
            return sum((_expected(stage, times) for stage in left), 0.0)
        passed, share = now - self._began, self._share
        planned = max(_expected(left[0], times) - passed, 0.1 * passed)
        running = (1 - share) * (passed + planned if share else planned)
        if passed > left[0][1]:
            times = [*times, (*left[0], passed)]
        return running + sum(_expected(stage, times) for stage in left[1:])


def _expected(stage: tuple[str, float], times: Sequence[tuple[str, float, float]]) -> float:
    """Return the seconds of a planned stage, by times of others: name, planned and measured."""
    weights = [planned**0.5 for _, planned, _ in times]
    ratios = [math.log(max(measured, 0.01) / planned) for _, planned, measured in times]
    total = sum(weight * ratio for weight, ratio in zip(weights, ratios, strict=True))
    mean = math.exp(total / (_TRUST + sum(weights)))
    own = [each[1:] for each in times if each[0] == stage[0]]
    planned, measured = map(sum, zip((_OWN_SECONDS, mean * _OWN_SECONDS), *own, strict=True))
    return stage[1] * measured / planned
