import sys
import time
from pathlib import Path

import pytest

from pimper_bench.baselines import openmvs
from pimper_bench.baselines.openmvs import find_program, run_program
from pimper_torch.runtime.errors import MissingProgramError, ReconstructionError


@pytest.fixture(autouse=True)
def _bare(monkeypatch, tmp_path):
    """Neither the machine's programs nor the user's variables."""
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("PIMPER_OPENMVS", raising=False)


def soon(minutes):
    return time.monotonic() + 60 * minutes


def script(path: Path, body: str) -> Path:
    path.write_text(f"#!{sys.executable}\n{body}\n")
    path.chmod(0o755)
    return path


def test_a_missing_program_is_named_with_its_source():
    with pytest.raises(MissingProgramError, match=r"tool is not installed.*https://github"):
        find_program("tool")


def test_the_variable_goes_before_the_path_before_usual_folders(monkeypatch, tmp_path):
    for name in ("usual", "named"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(openmvs, "_FOLDERS", (str(tmp_path / "usual"),))
    usual = script(tmp_path / "usual" / "tool", "")
    assert find_program("tool") == usual
    on_path = script(tmp_path / "bin" / "tool", "")
    assert find_program("tool") == on_path
    named = script(tmp_path / "named" / "tool", "")
    monkeypatch.setenv("PIMPER_OPENMVS", str(tmp_path / "named"))
    assert find_program("tool") == named
    named = script(tmp_path / "named" / "tool-2.1", "")
    monkeypatch.setenv("PIMPER_OPENMVS", str(named))
    assert find_program("tool") == named


def test_a_program_that_is_not_where_the_variable_says_is_not_looked_for_elsewhere(
    monkeypatch, tmp_path
):
    script(tmp_path / "bin" / "tool", "")
    (tmp_path / "text").write_text("not executable")
    for name in ("nowhere", "text"):
        monkeypatch.setenv("PIMPER_OPENMVS", str(tmp_path / name))
        with pytest.raises(MissingProgramError, match="where PIMPER_OPENMVS says"):
            find_program("tool")


def test_a_program_found_by_a_relative_path_runs_in_another_folder(monkeypatch, tmp_path):
    script(tmp_path / "bin" / "tool", "print('here')")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.setenv("PIMPER_OPENMVS", "bin")
    found = find_program("tool")
    assert run_program([found], tmp_path / "elsewhere", soon(1.0), 1) == "here\n"


def test_arguments_reach_the_program_untouched_by_a_shell(tmp_path):
    tool = script(tmp_path / "tool", "import sys, os; print(sys.argv[1:], os.getcwd())")
    printed = run_program([tool, "a b", "$HOME; exit 3"], tmp_path, soon(1.0), 3)
    assert printed == f"['a b', '$HOME; exit 3'] {tmp_path}\n"


def test_threads_are_told_to_openmp_and_what_is_printed_stays_in_the_folder(tmp_path):
    tool = script(tmp_path / "tool", "import os; print(os.environ['OMP_NUM_THREADS'])")
    assert run_program([tool], tmp_path, soon(1.0), 3) == "3\n"
    (log,) = tmp_path.glob("tool-*.log")
    assert log.read_text() == "3\n"


def test_a_failing_program_is_quoted_from_its_end(tmp_path):
    tool = script(
        tmp_path / "tool",
        "import sys\nfor i in range(40): print('line', i)\nsys.exit('no \\udcff disparity')",
    )
    with pytest.raises(ReconstructionError, match=r"exit status 1") as caught:
        run_program([tool], tmp_path, soon(1.0), 1)
    assert "line 39" in str(caught.value)
    assert "line 20" not in str(caught.value)


def test_a_program_that_a_signal_ended_is_said_so(tmp_path):
    tool = script(tmp_path / "tool", "import os; os.kill(os.getpid(), 9)")
    with pytest.raises(ReconstructionError, match=r"signal 9; often because memory.*nothing"):
        run_program([tool], tmp_path, soon(1.0), 1)


def test_at_the_deadline_the_program_and_its_children_are_stopped(tmp_path):
    child = "import time, pathlib; time.sleep(1.5); pathlib.Path('late').touch()"
    tool = script(
        tmp_path / "tool",
        "import subprocess, sys, time\nprint('begun', flush=True)\n"
        f"subprocess.Popen([sys.executable, '-c', {child!r}])\ntime.sleep(60)",
    )
    began = time.monotonic()
    with pytest.raises(ReconstructionError, match=r"(?s)minutes are over.*begun"):
        run_program([tool], tmp_path, soon(0.01), 1)
    assert time.monotonic() - began < 20
    time.sleep(1.6)
    assert not (tmp_path / "late").exists()


def test_a_file_that_is_no_program_for_this_machine_counts_as_missing(tmp_path):
    (tmp_path / "tool").write_bytes(b"\x7fELF of another kind")
    (tmp_path / "tool").chmod(0o755)
    with pytest.raises(MissingProgramError, match="cannot be started"):
        run_program([tmp_path / "tool"], tmp_path, soon(1.0), 1)


def test_programs_find_no_terminal_to_ask(tmp_path):
    tool = script(tmp_path / "tool", "import sys; print(repr(sys.stdin.read()))")
    assert run_program([tool], tmp_path, soon(1.0), 1) == "''\n"
