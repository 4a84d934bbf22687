import io

import pytest
from rich.console import Console

from pimper_torch.cli.bars import Bars
from pimper_torch.records import StageReport
from pimper_torch.runtime.reporting import Observer


def show(terminal, plan=()):
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, width=120)
    report = StageReport(
        name="warp",
        seconds=2.5,
        peak_memory_mb=9.0,
        figures={"samples": 12345, "missing_samples": 3086},
    )
    with Bars(console) as bars:
        bars.plan = plan
        assert isinstance(bars, Observer)
        bars.started("warp")
        bars.progressed(1, 4)
        bars.finished(report)
        bars.progressed(1, 4)  # late progress of a finished stage
    return text.getvalue()


def test_a_terminal_shows_a_bar_that_ends_full():
    shown = show(terminal=True)
    assert "100%" in shown
    assert "samples 12,345, missing samples 3,086" in shown


def test_a_log_file_has_one_line_per_stage():
    shown = show(terminal=False)
    assert " ".join(shown.split()) == "warp 2.5 s samples 12,345, missing samples 3,086"


@pytest.mark.parametrize(
    ("terminal", "seconds", "shown"),
    [
        (False, 0.0, ["10%", "20%", "50%", "60%", "70%", "80%", "90%"]),
        (False, 60.0, []),
        (True, 0.0, []),
    ],
)
def test_a_log_file_has_each_tenth_of_a_long_stage_once(terminal, seconds, shown):
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, width=120)
    with Bars(console, seconds=seconds) as bars:
        bars.started("write")
        for done in (1, 2, 3, 4, 5, *range(10, 21)):
            bars.progressed(done, 20)
    lines = [line.split() for line in text.getvalue().splitlines()]
    assert [words[1] for words in lines if len(words) == 2 and words[0] == "write"] == shown


def test_the_line_of_a_stage_has_the_remaining_time_of_the_run():
    plan = [("warp", 2.5), ("write", 600.0)]
    assert show(False, plan).splitlines()[0].endswith("samples 3,086  [about 10 minutes left]")
    assert "about 10 minutes left" in show(True, plan)
