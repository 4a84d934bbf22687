import io

from rich.console import Console

from pimper_torch.cli.bars import Bars
from pimper_torch.records import StageReport
from pimper_torch.reporting import Observer


def show(terminal):
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, width=120)
    report = StageReport(
        name="warp",
        seconds=2.5,
        peak_memory_mb=9.0,
        figures={"samples": 12345, "missing_fraction": 0.25},
    )
    with Bars(console) as bars:
        assert isinstance(bars, Observer)
        bars.started("warp")
        bars.progressed(1, 4)
        bars.finished(report)
        bars.progressed(1, 4)  # late news of a stage that has ended
    return text.getvalue()


def test_a_terminal_sees_a_bar_that_ends_full():
    shown = show(terminal=True)
    assert "100%" in shown
    assert "samples 12,345, missing fraction 0.25" in shown


def test_a_log_file_sees_one_line_a_stage():
    shown = show(terminal=False)
    assert " ".join(shown.split()) == "warp 2.5 s samples 12,345, missing fraction 0.25"
