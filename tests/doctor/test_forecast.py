"""Remaining time of a run, with a simulated clock."""

from itertools import pairwise

import pytest

from pimper_torch.cli.doctor import forecast as module
from pimper_torch.cli.doctor.cost import planned
from pimper_torch.cli.doctor.forecast import Forecast
from pimper_torch.records import StageReport

# Stages and seconds of two runs of the demo: `default`, and `fast` beside other programs. The last
# surface was compared with the silhouettes before it was extracted, and not by `judge`.
DEFAULT = """
reconstruct 29.8 silhouettes 17.3 contours 3.2 coarse_surface 30.5 explain 0.2 pyramids 0.8
decompose 0.1 warp 0.5 light 2.7 depth_from_light 3.2 photometry 2.5 gauge 0.0 fuse 2.8 repair 0.1
explain 0.2 remesh 0.1 decompose 1.0 warp 0.4 light 2.3 photometry 4.1 gauge 0.0 fuse 5.6 repair
0.3 explain 0.5 remesh 0.1 decompose 2.7 warp 0.6 light 2.2 photometry 8.3 gauge 0.1 fuse 24.2
repair 1.0 extract 3.4 judge 1.6 simplify 2.0 relight 7.6 texture 5.9 judge_textures 1.2 draw
6.6 write 2.2
"""
FAST = """
reconstruct 51.1 silhouettes 19.1 contours 8.8 coarse_surface 32.2 explain 0.3 pyramids 3.4
decompose 0.3 warp 3.1 light 4.9 depth_from_light 10.7 photometry 10.0 gauge 0.1 fuse 11.9 repair
0.5 extract 2.0 judge 0.9 simplify 0.5 relight 22.0 texture 4.1 judge_textures 2.1 draw 7.3
write 2.4
"""

SCALES = {DEFAULT: (0.25, 0.5, 1.0), FAST: (0.4,)}
DEMO = planned(12.96, 24)


class Clock:
    now = 1000.0

    def perf_counter(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


def recorded(text):
    words = text.split()
    return [(name, float(seconds)) for name, seconds in zip(words[::2], words[1::2], strict=True)]


def report(name, seconds, kept=False):
    return StageReport(name=name, seconds=seconds, peak_memory_mb=0.0, figures={}, kept=kept)


def play(clock, plan, stages, step=1.0):
    """Return the passed seconds and the time left that is displayed every second of a run."""
    forecast, began = Forecast(), clock.now
    forecast.expect(plan)
    shown = [(0.0, forecast.seconds_left())]
    for name, seconds in stages:
        forecast.started(name)
        end = clock.now + seconds
        while clock.now < end:
            clock.now = min(end, clock.now + step)
            shown.append((clock.now - began, forecast.seconds_left()))
        forecast.finished(report(name, seconds))
    shown.append((clock.now - began, forecast.seconds_left()))
    return shown


def check(shown, part=0.5):
    """Check that the time left does not jump, and that its error halves until a part of the run."""
    total = shown[-1][0]
    for (before, earlier), (after, later) in pairwise(shown):
        change = 1.2 ** (min(10.0, after - before) / 10)
        assert later <= change * max(1.0, earlier) + 1e-6
        assert later >= (earlier - (after - before)) / change**2 - 1e-6 or after == total
    errors = [(passed, abs(passed + left - total)) for passed, left in shown]
    middle = next(error for passed, error in errors if passed >= part * total)
    assert middle <= max(0.5 * errors[0][1], 0.03 * total)
    assert shown[-1][1] == 0


@pytest.mark.parametrize("slowness", [0.5, 1, 2.5])
def test_the_time_left_of_a_slower_or_faster_machine_does_not_jump(clock, slowness):
    check(play(clock, DEMO, [(name, slowness * seconds) for name, seconds in DEMO]))


@pytest.mark.parametrize(
    ("slow", "part"),
    [
        ("coarse_surface", 0.5),
        ("fuse", 0.5),
        # In the middle, these are all that has run, or take most of their time later.
        *(("reconstruct", 0.75), ("silhouettes", 0.75), ("light", 0.75), ("photometry", 0.75)),
    ],
)
def test_one_slow_stage_does_not_let_the_time_left_jump(clock, slow, part):
    stages = [(name, (3 if name == slow else 1) * seconds) for name, seconds in DEMO]
    check(play(clock, DEMO, stages), part)


@pytest.mark.parametrize("text", [DEFAULT, FAST])
@pytest.mark.parametrize("step", [0.25, 1.0, 30.0])
def test_the_time_left_of_recorded_runs_does_not_jump(clock, text, step):
    check(play(clock, planned(12.96, 24, SCALES[text]), recorded(text), step))


def test_the_plan_lists_the_stages_of_a_run_in_their_order():
    short = ("warp", "gauge", "remesh")  # a second or less for the demo
    ran = [name for name, _ in recorded(DEFAULT) if name not in short]
    assert [name for name, _ in DEMO] == ran


def test_the_plan_has_the_shares_of_a_recorded_run():
    """Stages that take more than a twentieth are planned within a factor of 1.6."""
    run, plan = recorded(DEFAULT), {}
    for name, seconds in DEMO:
        plan[name] = plan.get(name, 0.0) + seconds
    taken = {name: sum(seconds for other, seconds in run if other == name) for name in plan}
    for name, seconds in plan.items():
        if taken[name] > 0.05 * sum(taken.values()):
            share = (seconds / sum(plan.values())) / (taken[name] / sum(taken.values()))
            assert 1 / 1.6 < share < 1.6, name


PLAN = [("find", 10.0), ("pass", 2.0), ("end", 1.0), ("pass", 8.0), ("end", 4.0)]


@pytest.fixture
def forecast():
    forecast = Forecast()
    forecast.expect(PLAN)
    return forecast


def ran(forecast, clock, name, seconds, kept=False):
    forecast.started(name)
    clock.now += 0.0 if kept else seconds
    forecast.finished(report(name, seconds, kept))


def test_the_running_stage_counts_down(forecast, clock):
    assert forecast.seconds_left() == 25.0
    forecast.started("find")
    clock.now += 4.0
    assert forecast.seconds_left() == pytest.approx(21.0)
    clock.now += 4.0
    assert forecast.seconds_left() == pytest.approx(17.0)


def test_progress_corrects_the_running_stage(forecast, clock):
    forecast.started("find")
    clock.now += 5.0
    forecast.progressed(9, 10)
    assert forecast.seconds_left() == pytest.approx(0.1 * 10 + 15)


def test_kept_and_skipped_stages_leave_the_time_left_at_once(forecast, clock):
    assert forecast.seconds_left() == 25.0
    ran(forecast, clock, "find", 1000.0, kept=True)
    assert forecast.seconds_left() == 15.0
    ran(forecast, clock, "unknown", 0.0)
    assert forecast.seconds_left() == 15.0
    ran(forecast, clock, "end", 1.0)  # without the previous pass
    assert forecast.seconds_left() == pytest.approx(12.0, abs=0.1)


def test_a_stage_that_is_repeated_within_a_pass_skips_none(clock):
    forecast = Forecast()
    plan = [(name, 1.0) for _ in range(2) for name in ("cut", "light", "fit", "join", "mend")]
    forecast.expect(plan)
    for name in ("cut", "light", "cut", "light"):
        ran(forecast, clock, name, 1.0)
    assert forecast.seconds_left() == pytest.approx(8.0)


def test_a_stage_that_did_not_run_before_skips_all_others(clock):
    forecast = Forecast()
    forecast.expect([(name, 1.0) for name in ("a", "b", "c", "d", "e", "f")])
    for name in ("a", "e"):
        ran(forecast, clock, name, 1.0)
    assert forecast.seconds_left() == pytest.approx(1.0)


def test_another_run_begins_anew(forecast, clock):
    ran(forecast, clock, "find", 30.0)
    forecast.expect(PLAN[:3])
    assert forecast.seconds_left() == 13.0


def test_without_a_plan_there_is_no_forecast(clock):
    forecast = Forecast()
    ran(forecast, clock, "warp", 3.0)
    assert forecast.seconds_left() is None


def test_given_inputs_reduce_the_plan():
    def seconds(**given):
        return sum(seconds for _, seconds in planned(10.0, 20, **given))

    assert seconds(cameras=True, masks=True) < min(seconds(cameras=True), seconds(masks=True))
    assert max(seconds(cameras=True), seconds(masks=True)) < seconds()
    assert seconds(scales=(0.4,)) < seconds()
