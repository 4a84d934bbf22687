import sys
import time
from pathlib import Path

import pytest

from pimper_bench.baselines import openmvs
from pimper_bench.baselines.missing import MissingProgramError
from pimper_bench.baselines.openmvs import find_program, run_program
from pimper_torch.runtime.errors import ReconstructionError


def soon(minutes):
    return time.monotonic() + 60 * minutes


def script(path: Path, body: str) -> Path:
    path.write_text(f"#!{sys.executable}\n{body}\n")
    path.chmod(0o755)
    return path


def test_a_missing_program_is_named_with_its_source():
    with pytest.raises(MissingProgramError, match=r"tool is not installed.*https://github"):
        find_program("tool")


def test_the_path_takes_precedence_over_usual_folders(monkeypatch, tmp_path):
    (tmp_path / "usual").mkdir()
    monkeypatch.setattr(openmvs, "_FOLDERS", (str(tmp_path / "usual"),))
    usual = script(tmp_path / "usual" / "tool", "")
    assert find_program("tool") == usual
    on_path = script(tmp_path / "bin" / "tool", "")
    assert find_program("tool") == on_path


def test_a_program_with_a_relative_path_runs_in_a_different_folder(monkeypatch, tmp_path):
    script(tmp_path / "bin" / "tool", "print('here')")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.setenv("PATH", "bin")
    assert run_program([find_program("tool")], tmp_path / "elsewhere", soon(1.0), 1) == "here\n"


def test_a_program_gets_its_arguments_and_threads_without_a_shell_or_terminal(tmp_path):
    tool = script(
        tmp_path / "tool",
        "import sys, os\n"
        "print(sys.argv[1:], os.getcwd(), os.environ['OMP_NUM_THREADS'], repr(sys.stdin.read()))",
    )
    printed = run_program([tool, "a b", "$HOME; exit 3"], tmp_path, soon(1.0), 3)
    assert printed == f"['a b', '$HOME; exit 3'] {tmp_path} 3 ''\n"
    (log,) = tmp_path.glob("tool-*.log")
    assert log.read_text() == printed


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (
            "import sys\nfor i in range(40): print('line', i)\nsys.exit('no \\udcff disparity')",
            r"(?s)exit status 1\)\.\nIts last lines:\n  line 26\n.*line 39",
        ),
        ("import os; os.kill(os.getpid(), 9)", "signal 9; often because memory.*nothing"),
    ],
)
def test_a_failing_program_is_quoted_from_its_end(tmp_path, body, message):
    tool = script(tmp_path / "tool", body)
    with pytest.raises(ReconstructionError, match=message):
        run_program([tool], tmp_path, soon(1.0), 1)


def test_at_the_deadline_the_program_and_its_children_are_stopped(tmp_path):
    child = "import time, pathlib; time.sleep(1.5); pathlib.Path('late').touch()"
    tool = script(
        tmp_path / "tool",
        "import subprocess, sys, time\nprint('begun', flush=True)\n"
        f"subprocess.Popen([sys.executable, '-c', {child!r}])\ntime.sleep(60)",
    )
    began = time.monotonic()
    with pytest.raises(ReconstructionError, match=r"(?s)time limit of .*exceeded.*begun"):
        run_program([tool], tmp_path, soon(0.01), 1)
    assert time.monotonic() - began < 20
    time.sleep(1.6)
    assert not (tmp_path / "late").exists()


def test_a_program_that_cannot_be_executed_counts_as_missing(tmp_path):
    (tmp_path / "tool").write_bytes(b"\x7fELF of another kind")
    (tmp_path / "tool").chmod(0o755)
    with pytest.raises(MissingProgramError, match="cannot be started"):
        run_program([tmp_path / "tool"], tmp_path, soon(1.0), 1)
