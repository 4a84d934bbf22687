"""Ctrl-C after the first pass leaves the result of the last complete pass."""

import json
import os
import signal
import time

import pytest
import yaml
from command_line import small_run

from pimper_torch.cli.main import main
from pimper_torch.stages.photometry.gauge import FixGauge

pytestmark = [
    pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning"),
    pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals of POSIX"),
]

PRESET = "scales: [0.25, 0.5, 1.0]\nsweep: {min_views: 2, num_views: 4}\n"
PRESET += "extract: {max_expected_error: 9}\n"


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """Arguments of a run of three passes on a small ball."""
    return [*small_run(tmp_path_factory.mktemp("ball"), PRESET), "--no-report"]


@pytest.fixture
def interrupted(monkeypatch):
    """Send signals in the calls of one stage with these numbers, counted from 1."""

    def send(numbers):
        calls, usual = [], FixGauge.forward

        def counted(self, photometric):
            calls.append(1)
            if number := numbers.get(len(calls)):
                time.sleep(1.1)  # a second press within a second is taken for the same
                os.kill(os.getpid(), number)
            return usual(self, photometric)

        monkeypatch.setattr(FixGauge, "forward", counted)

    former = signal.signal(signal.SIGINT, signal.default_int_handler)  # may be ignored
    yield send
    signal.signal(signal.SIGINT, former)


def run_into(out, arguments, *more):
    code = main([*arguments, "-o", str(out), *more])
    path = out / "summary.json"
    return code, json.loads(path.read_text()) if path.exists() else None


@pytest.mark.slow
def test_ctrl_c_in_the_second_pass_writes_the_result_of_the_first(
    line, interrupted, tmp_path, capsys
):
    interrupted({2: signal.SIGINT})
    code, summary = run_into(tmp_path / "out", line)
    printed = capsys.readouterr()
    assert code == 0
    stopping = "Stopping: the result of pass 1 of 3 is written; press Ctrl-C again to stop without"
    assert stopping in printed.out
    assert summary["verdict"]["text"].endswith(". Stopped after pass 1 of 3.")
    assert summary["verdict"]["text"] in printed.out
    (warning,) = [each for each in summary["warnings"] if each.startswith("Stopped after pass 1")]
    assert f"warning: {warning}" in printed.err
    assert len(summary["warnings"]) == len({*summary["warnings"]})
    computed = [one["name"] for one in summary["stages"] if not one["kept"]]
    assert (computed.count("photometry"), computed.count("fuse")) == (2, 2)
    # The result is that of a run with one pass.
    code, _ = run_into(tmp_path / "once", line, "--scales", "(0.25,)")
    assert code == 0
    for name in ("mesh.ply", "config.yaml"):
        written = [(tmp_path / out / name).read_bytes() for out in ("out", "once")]
        assert written[0] == written[1], name
    # The same command continues.
    code, whole = run_into(tmp_path / "out", line, "--overwrite")
    assert code == 0
    kept = [one["name"] for one in whole["stages"] if one["kept"]]
    assert kept.count("photometry") == 2
    assert "Stopped" not in whole["verdict"]["text"]
    config = yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())
    assert config.get("scales", [0.25, 0.5, 1.0]) == [0.25, 0.5, 1.0]


@pytest.mark.parametrize(
    ("numbers", "code"),
    [
        ({1: signal.SIGINT}, 130),
        ({2: signal.SIGTERM}, 143),
        ({2: signal.SIGINT, 3: signal.SIGINT}, 130),
    ],
)
def test_without_a_complete_pass_or_with_another_signal_nothing_is_written(
    line, interrupted, tmp_path, capsys, numbers, code
):
    interrupted(numbers)
    assert run_into(tmp_path / "out", line) == (code, None)
    assert "interrupted; no result was written." in capsys.readouterr().err


def test_events_have_the_passes_whose_result_is_written(line, interrupted, tmp_path, capsys):
    interrupted({2: signal.SIGINT})
    assert run_into(tmp_path / "out", line, "--json")[0] == 0
    printed = [json.loads(each) for each in capsys.readouterr().out.splitlines()]
    (stopping,) = [each for each in printed if each["event"] == "stopping"]
    assert (stopping["passes"], stopping["total"]) == (1, 3)
    assert printed[-1]["event"] == "result"
