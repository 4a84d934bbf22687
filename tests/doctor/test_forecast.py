"""Remaining time of a run, with a simulated clock."""

import pytest

from pimper_torch.cli.doctor import forecast as module
from pimper_torch.cli.doctor.cost import planned
from pimper_torch.cli.doctor.forecast import Forecast
from pimper_torch.records import StageReport

PLAN = [("find", 10.0), ("pass", 2.0), ("end", 1.0), ("pass", 8.0), ("end", 4.0)]


class Clock:
    now = 0.0

    def perf_counter(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


@pytest.fixture
def forecast():
    forecast = Forecast()
    forecast.plan = PLAN
    return forecast


def ran(forecast, clock, name, seconds, kept=False):
    forecast.started(name)
    clock.now += 0.0 if kept else seconds
    report = StageReport(name=name, seconds=seconds, peak_memory_mb=0.0, figures={}, kept=kept)
    forecast.finished(report)


def test_a_slower_machine_scales_the_plan(forecast, clock):
    assert forecast.seconds_left() == 25.0
    ran(forecast, clock, "find", 30.0)
    # The plan has a weight of 1.25 s against the finished 10 s.
    assert forecast.seconds_left() == pytest.approx(15 * 31.25 / 11.25)
    ran(forecast, clock, "pass", 6.0)
    ran(forecast, clock, "end", 3.0)
    assert forecast.seconds_left() == pytest.approx(12 * 3.0)


def test_a_later_pass_is_scaled_by_the_previous_one(forecast, clock):
    for name, seconds in (("find", 10.0), ("pass", 10.0), ("end", 1.0)):
        ran(forecast, clock, name, seconds)
    assert forecast.seconds_left() == pytest.approx(5 * 8 + 4)


def test_the_running_stage_counts_down(forecast, clock):
    forecast.started("find")
    clock.now = 4.0
    assert forecast.seconds_left() == 21.0
    forecast.progressed(1, 4)
    assert forecast.seconds_left() == 0.75 * 10 + 15
    forecast.progressed(4, 4)
    assert forecast.seconds_left() == 15.0


def test_a_slow_stage_scales_the_remaining_ones(forecast, clock):
    forecast.started("find")
    forecast.progressed(1, 4)
    clock.now = 40.0
    assert forecast.seconds_left() == pytest.approx(0.75 * 40 + 15 * 41.25 / 11.25)


def test_stored_records_and_skipped_stages_take_no_time(forecast, clock):
    ran(forecast, clock, "find", 1000.0, kept=True)
    assert forecast.seconds_left() == 15.0
    ran(forecast, clock, "unknown", 3.0)
    assert forecast.seconds_left() == 15.0
    ran(forecast, clock, "end", 1.0)  # without the previous pass
    assert forecast.seconds_left() == 12.0
    ran(forecast, clock, "pass", 8.0)
    ran(forecast, clock, "end", 4.0)
    assert forecast.seconds_left() == 0.0


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
