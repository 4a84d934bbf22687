import io
import re

import pytest
from rich.console import Console

from pimper_torch.chains.coarse_to_fine import CoarseToFine
from pimper_torch.cli.bars import PHRASES, Bars
from pimper_torch.paper.chain import Published
from pimper_torch.records import StageReport
from pimper_torch.runtime.reporting import Observer


def show(terminal, plan=(), figures=False):
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, width=80)
    report = StageReport(
        name="warp",
        seconds=2.5,
        peak_memory_mb=9.0,
        figures={"samples": 12345, "missing_samples": 3086},
    )
    with Bars(console, figures) as bars:
        bars.expect(plan)
        assert isinstance(bars, Observer)
        bars.started("warp")
        bars.progressed(1, 4)
        bars._live.refresh()
        bars.finished(report)
        bars.progressed(1, 4)  # late progress of a finished stage
    return text.getvalue()


def rows(shown):
    """Return what a terminal displays one after the other, without escape sequences."""
    plain = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", shown)
    return [row for row in re.split(r"[\r\n]+", plain) if row.strip()]


def test_a_terminal_shows_one_bar_with_the_stage_in_plain_words():
    shown = rows(show(True, [("warp", 10.0), ("write", 600.0)]))
    assert all(row.startswith("sampling photographs ") for row in shown)
    assert all(row.rstrip().endswith("about 10 minutes left") for row in shown)
    assert not any("samples" in row for row in shown)


def test_the_bar_shows_the_stage_until_there_is_a_plan_and_then_the_run():
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    bars = Bars(console)
    bars.started("read")
    bars.progressed(24, 24)
    console.print(bars._bar())
    bars.expect([("warp", 600.0)])
    bars.started("warp")
    console.print(bars._bar())
    assert [re.findall(r"\d+%", row) for row in rows(console.file.getvalue())] == [["100%"], ["0%"]]


@pytest.mark.parametrize("terminal", [True, False])
def test_figures_of_stages_are_shown_on_request(terminal):
    line = "warp 2.5 s samples 12,345, missing samples 3,086"
    shown = show(terminal, figures=True)
    assert line in [" ".join(row.split()) for row in rows(shown)]


def test_a_log_file_has_one_line_per_stage():
    assert " ".join(show(terminal=False).split()) == "warp 2.5 s"


@pytest.mark.parametrize("stage", [*PHRASES, "a_stage_of_a_different_package"])
def test_no_line_is_cut_at_80_columns(stage):
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    bars = Bars(console)
    bars.expect([(stage, 5900.0)])
    bars.started(stage)
    console.print(bars._bar())
    (row,) = rows(console.file.getvalue())
    assert row.startswith(PHRASES.get(stage, stage))
    assert row.rstrip().endswith("about 98 minutes left")
    assert len(row) <= 80


def test_every_stage_of_the_chains_has_a_phrase():
    for chain in (CoarseToFine(), Published()):
        assert {name for name, _ in chain.named_children()} <= {*PHRASES}


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
    assert show(False, plan).splitlines()[0].endswith("2.5 s  [about 10 minutes left]")
