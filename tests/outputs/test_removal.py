"""Cleaning removes what runs kept and left, and neither results nor what somebody else wrote."""

import subprocess
import sys

import pytest

from pimper_torch.cli.main import main
from pimper_torch.doors.outputs.folders import clean_output, held_output, written_whole
from pimper_torch.doors.outputs.marker import MARKER, STAGES
from pimper_torch.runtime.errors import OutputError

KILLED = """
import os, signal, sys
from pathlib import Path
from pimper_torch.doors.outputs.folders import held_output, written_whole
folder = Path(sys.argv[1])
with held_output(folder, "result", overwrite=True):
    (folder / ".stages" / "mesh.pt").write_bytes(bytes(3_000_000))
    with written_whole(folder, "result", overwrite=True) as filled:
        (filled / "mesh.ply").write_bytes(bytes(2_000_000))
        os.kill(os.getpid(), signal.SIGKILL)
"""


def kill_a_run(folder):
    ran = subprocess.run([sys.executable, "-c", KILLED, str(folder)])
    assert ran.returncode == -9


def held(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("former", [True, False])
def test_what_a_killed_run_kept_and_left_is_removed(tmp_path, capsys, former):
    out = tmp_path / "out"
    if former:
        with written_whole(out, "result") as filled:
            (filled / "mesh.ply").write_text("whole")
    kill_a_run(out)
    assert STAGES in held(out)
    assert held(tmp_path) == ["out"]
    assert main(["clean", str(out)]) == 0
    assert "5.0 MB freed" in capsys.readouterr().out
    assert held(tmp_path) == ["out"]
    assert held(out) == ([MARKER, "mesh.ply"] if former else [])
    if former:
        assert (out / "mesh.ply").read_text() == "whole"
        assert main(["clean", str(out)]) == 0  # again: there is nothing to remove
        assert "out: nothing to remove." in capsys.readouterr().out


@pytest.mark.parametrize("name", ["mine", "nowhere", "file", "mine/.stages", "empty"])
def test_a_folder_that_is_not_ours_is_refused(tmp_path, name):
    (tmp_path / "empty" / STAGES).mkdir(parents=True)
    (tmp_path / "mine" / STAGES).mkdir(parents=True)
    (tmp_path / "mine" / STAGES / "act_one.txt").write_text("a play")
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="needed: the folder"):
        clean_output(tmp_path / name)
    assert (tmp_path / "mine" / STAGES / "act_one.txt").exists()
    assert (tmp_path / "empty" / STAGES).exists()


def test_a_folder_that_is_held_is_refused(tmp_path):
    with held_output(tmp_path / "out", "result"):
        (tmp_path / "out" / STAGES / "mesh.pt").touch()
        with pytest.raises(OutputError, match="another run writes there"):
            clean_output(tmp_path / "out")
        assert (tmp_path / "out" / STAGES / "mesh.pt").exists()
