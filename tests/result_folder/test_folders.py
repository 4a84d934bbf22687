"""Result folders: no file is lost or incomplete, and two runs do not write to one folder."""

import errno
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pimper_torch.cli.main import main
from pimper_torch.export.result_folder.folders import (
    clean_output,
    held_output,
    prepare_output,
    require_apart,
    written_whole,
)
from pimper_torch.export.result_folder.marker import MARKER, STAGES, read_marker
from pimper_torch.runtime.errors import InputError, OutputError


def held(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def contents(folder: Path) -> dict[str, str]:
    """Return the content of every file of a result, without the marker."""
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != MARKER and STAGES not in path.parts
    }


def result(text: str, *more: str) -> dict[str, str]:
    return {name: f"{text} {name}" for name in ("mesh.ply", "sparse/cameras.bin", *more)}


def write(folder: Path, files: dict[str, str], *, overwrite: bool = False) -> None:
    with written_whole(folder, "result", overwrite=overwrite) as filled:
        fill(filled, files)


def fill(folder: Path, files: dict[str, str], error: BaseException | None = None) -> None:
    """Write files, then raise the error, if any."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    if error is not None:
        raise error


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A folder with a result, inside an otherwise empty folder."""
    folder = tmp_path / "all" / "out"
    write(folder, result("first", "masks/a.png"))
    return folder


def test_the_marker_lists_the_written_files(out):
    marker = read_marker(out)
    assert marker.kind == "result"
    assert marker.files == {"mesh.ply", "sparse/cameras.bin", "masks/a.png"}
    assert held(out) == [MARKER, "masks", "mesh.ply", "sparse"]


def test_a_result_is_replaced_only_on_request(out):
    with pytest.raises(OutputError, match=r"already contains masks, mesh\.ply, sparse"):
        write(out, result("second"))
    write(out, result("second"), overwrite=True)
    assert contents(out) == result("second")  # and the mask is gone
    assert held(out.parent) == ["out"]


def change(path: Path) -> None:
    """Write a file of the same size a second after the result was written."""
    later = (path.parents[1] / MARKER).stat().st_mtime_ns + 10**9
    path.write_bytes(path.read_bytes()[::-1])
    os.utime(path, ns=(later, later))


def link(path: Path) -> None:
    """Replace a file or folder by a symbolic link."""
    path.rename(path.parents[2] / path.name)
    path.symlink_to(path.parents[2] / path.name)


SPOILED = {
    r"notes\.txt": lambda out: fill(out, {"notes.txt": "years of work"}),
    r"sparse/mine\.txt": lambda out: fill(out, {"sparse/mine.txt": "years of work"}),
    r"masks/old/b\.png": lambda out: fill(out, {"masks/old/b.png": "years of work"}),
    "contains new, ": lambda out: (out / "new").mkdir(),
    r"masks/a\.png \(changed since it was written\)": lambda out: change(out / "masks" / "a.png"),
    r"mesh\.ply": lambda out: link(out / "mesh.ply"),
    "sparse, ": lambda out: link(out / "sparse"),
    "not the list of files of a previous run": lambda out: (out / MARKER).unlink(),
}


@pytest.mark.parametrize("message", SPOILED)
def test_files_outside_a_result_are_named_and_kept(out, message):
    SPOILED[message](out)
    before = contents(out), held(out)
    with pytest.raises(OutputError, match=message):
        write(out, result("second"), overwrite=True)
    assert (contents(out), held(out)) == before


def test_a_copy_of_a_result_is_a_result(out, tmp_path):
    shutil.copytree(out, tmp_path / "copy")
    write(tmp_path / "copy", result("second"), overwrite=True)
    assert contents(tmp_path / "copy") == result("second")


def test_the_marker_of_a_former_version_is_read(out):
    content = json.loads((out / MARKER).read_text())
    files = {name: [9, 0, "hash"] for name in content["files"]}
    (out / MARKER).write_text(json.dumps(content | {"format_version": 1, "files": files}))
    write(out, result("second"), overwrite=True)
    assert contents(out) == result("second")


def test_an_output_folder_of_a_different_kind_is_not_replaced(out):
    with pytest.raises(OutputError, match="contains a result, and is not overwritten by a scene"):
        prepare_output(out, "scene", overwrite=True)


WRONG = [
    lambda content: [],
    lambda content: content | {"format": "another"},
    lambda content: content | {"format_version": 3},
    lambda content: content | {"kind": "letters"},
    lambda content: content | {"files": 3},
]


@pytest.mark.parametrize("change", [*WRONG, "", "{", "[" * 100_000, "\udcff"])
def test_an_invalid_marker_is_not_trusted(out, change):
    if not isinstance(change, str):
        change = json.dumps(change(json.loads((out / MARKER).read_text())))
    (out / MARKER).write_bytes(change.encode("utf-8", "surrogateescape"))
    with pytest.raises(OutputError, match="not the list of files of a previous run"):
        write(out, result("second"), overwrite=True)


@pytest.mark.parametrize(
    "name", ["../mine.txt", "sparse/../../mine.txt", "{}/mine.txt", ".stages/lock"]
)
def test_a_marker_cannot_remove_files_outside_its_folder(out, name):
    mine, content = out.parent / "mine.txt", json.loads((out / MARKER).read_text())
    mine.write_text("years of work")
    listed = [*content["files"], name.format(out.parent)]
    (out / MARKER).write_text(json.dumps(content | {"files": listed}))
    write(out, result("second"), overwrite=True)
    assert contents(out) == result("second")
    assert mine.read_text() == "years of work"


def test_stored_stages_survive_a_replacement_without_a_copy(out):
    for overwrite in (False, True):
        folder = out if overwrite else out.with_name("fresh")
        (folder / STAGES).mkdir(parents=True)
        fill(folder / STAGES, {"mesh.pt": "kept", "lock": ""})
        number = (folder / STAGES / "mesh.pt").stat().st_ino
        write(folder, result("second"), overwrite=overwrite)
        assert (folder / STAGES / "mesh.pt").stat().st_ino == number
        assert contents(folder) == result("second")
    assert held(out.parent) == ["fresh", "out"]


def test_a_foreign_folder_of_stages_is_refused(tmp_path):
    fill(tmp_path / "out" / STAGES, {"act_one.txt": "a play"})
    with pytest.raises(OutputError, match="is not from pimper"):
        prepare_output(tmp_path / "out", "result", overwrite=True)
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / STAGES).symlink_to(tmp_path / "out" / STAGES)
    with pytest.raises(OutputError, match="is not from pimper"):
        prepare_output(tmp_path / "linked", "result")


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt()])
def test_a_failed_run_leaves_only_the_former_result(out, tmp_path, error):
    for folder, overwrite in ((out, True), (tmp_path / "new" / "deep", False)):
        with (
            pytest.raises((OutputError, KeyboardInterrupt)) as raised,
            written_whole(folder, "result", overwrite=overwrite) as filled,
        ):
            fill(filled, {"mesh.ply": "half"}, error)
        if isinstance(error, OSError):
            assert re.search("writing failed .*No space left", str(raised.value))
    assert contents(out) == result("first", "masks/a.png")
    assert held(out.parent) == ["out"]
    assert held(tmp_path) == ["all"]


KILLED_AT_EVERY_STEP = """
import os, shutil, signal, sys
from pathlib import Path
from pimper_torch.export.result_folder.folders import held_output, written_whole
folder = Path(sys.argv[1])
first = {"mesh.ply": "first", "masks/a.png": "the same", "masks/b.png": "first"}
second = {"mesh.ply": "second", "masks/a.png": "the same", "lights/all/c.json": "second"}

def write(files):
    with held_output(folder, "result", overwrite=True):
        (folder / ".stages" / "mesh.pt").write_text("kept")
        with written_whole(folder, "result", overwrite=True) as filled:
            for name, text in files.items():
                (filled / name).parent.mkdir(parents=True, exist_ok=True)
                (filled / name).write_text(text)

def contents():
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != ".pimper.json"]
    names = {path: path.relative_to(folder).as_posix() for path in files}
    return {name: path.read_text() for path, name in names.items() if name[:7] != ".stages"}

def die_before(step):
    count = 0
    def hear(event, given):
        nonlocal count
        writes = event == "open" and given[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        if event in ("os.rename", "os.remove", "os.rmdir", "os.mkdir") or writes:
            count += 1
            if count == step:
                os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(hear)

for overwrite in (False, True):
    status, step, seen = 1, 0, set()
    while status:
        step += 1
        shutil.rmtree(folder, ignore_errors=True)
        if overwrite:
            write(first)
        child = os.fork()
        if child == 0:
            die_before(step)
            write(second)
            os._exit(0)
        status = os.waitpid(child, 0)[1]
        assert status in (0, signal.SIGKILL), status
        if (folder / ".pimper.json").exists():  # whole: the former result, or the new one
            assert contents() in ([first, second] if overwrite else [second]), step
            seen.add(contents()["mesh.ply"])
        elif not (folder / ".stages" / "new" / ".pimper.json").exists():
            assert not overwrite and contents() == {}, step
        else:  # whole, and on its way
            with held_output(folder, "result", overwrite=True):
                assert contents() == second, step
            seen.add("on its way")
        write(second)
        assert contents() == second, step
        assert sorted(os.listdir(folder / ".stages")) == ["lock", "mesh.pt"], step
    print(step, *sorted(seen))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_run_killed_at_any_step_leaves_a_complete_result(tmp_path):
    """A folder with its marker is complete; if the marker is missing, the next run completes it."""
    line = [sys.executable, "-c", KILLED_AT_EVERY_STEP, str(tmp_path / "out")]
    ran = subprocess.run(line, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    steps, seen = zip(*(said.split(" ", 1) for said in ran.stdout.splitlines()), strict=True)
    assert min(map(int, steps)) > 30
    assert seen == ("on its way second", "first on its way second")


def test_the_current_directory_survives_a_replacement(out, monkeypatch):
    monkeypatch.chdir(out)
    write(Path(), result("second"), overwrite=True)
    assert contents(Path()) == contents(out) == result("second")


HOLDS = """
import sys, time
from pathlib import Path
from pimper_torch.export.result_folder.folders import held_output, written_whole
folder = Path(sys.argv[1])
with held_output(folder, "result", overwrite=True):
    (folder / ".stages" / "mesh.pt").write_bytes(b"kept")
    with written_whole(folder, "result", overwrite=True) as filled:
        (filled / "mesh.ply").write_bytes(b"half")
        print("ready", flush=True)
        time.sleep(60)
"""


@contextmanager
def run_that_holds(folder: Path) -> Iterator[int]:
    """Start a run that writes half of its result, and kill it at the end of the block."""
    line = [sys.executable, "-c", HOLDS, str(folder)]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "ready\n"
            yield process.pid
        finally:
            process.kill()


def test_a_second_run_is_refused_and_a_killed_one_leaves_no_lock(out, tmp_path):
    for folder in (out, tmp_path / "fresh"):
        with (
            run_that_holds(folder) as number,
            pytest.raises(
                OutputError, match=rf"another run is writing to it: process {number} on .*-c"
            ),
        ):
            write(folder, result("second"), overwrite=True)
        assert (folder / STAGES / "new" / "mesh.ply").read_text() == "half"
        write(folder, result("second"), overwrite=True)
        assert contents(folder) == result("second")
        assert (folder / STAGES / "mesh.pt").read_text() == "kept"
        assert held(folder / STAGES) == ["lock", "mesh.pt"]


@pytest.mark.parametrize("former", [True, False])
def test_remains_of_a_killed_run_are_cleaned(out, tmp_path, capsys, former):
    folder = out if former else tmp_path / "fresh"
    with run_that_holds(folder), pytest.raises(OutputError, match="another run is writing to it"):
        clean_output(folder)
    assert (folder / STAGES / "mesh.pt").exists()
    assert main(["clean", str(folder), "--json"]) == 0
    assert '"freed_bytes": 8' in capsys.readouterr().out
    assert contents(folder) == (result("first", "masks/a.png") if former else {})
    assert STAGES not in held(folder)
    if former:
        assert clean_output(folder) == 0  # a second time: no file is left to remove


@pytest.mark.parametrize("name", ["mine", "nowhere", "file", "mine/.stages", "empty"])
def test_cleaning_refuses_a_foreign_folder(tmp_path, name):
    (tmp_path / "empty" / STAGES).mkdir(parents=True)
    fill(tmp_path, {f"mine/{STAGES}/act_one.txt": "a play", "file": ""})
    with pytest.raises(OutputError, match="needed: the folder"):
        clean_output(tmp_path / name)
    assert (tmp_path / "mine" / STAGES / "act_one.txt").exists()
    assert (tmp_path / "empty" / STAGES).exists()


def test_a_second_thread_is_refused_and_a_nested_block_is_not(tmp_path):
    refused = []

    def other():
        try:
            write(tmp_path / "out", result("second"))
        except OutputError as error:
            refused.append(str(error))

    with held_output(tmp_path / "out", "result"):
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        write(tmp_path / "out", result("first"))
    assert "another run is writing to it" in refused[0]
    assert contents(tmp_path / "out") == result("first")


def test_a_file_added_during_the_run_does_not_lose_the_result(out):
    with (
        pytest.raises(OutputError, match=rf"letter\.txt.* The new result is in .*{STAGES}/new\."),
        written_whole(out, "result", overwrite=True) as filled,
    ):
        fill(filled, result("second") | {"../../letter.txt": "dear"})
    with pytest.raises(OutputError, match=r"letter\.txt"):
        clean_output(out)
    assert (out / STAGES / "new" / "mesh.ply").exists()
    (out / "letter.txt").unlink()
    clean_output(out)
    assert contents(out) == result("second")
    assert held(out) == [MARKER, "mesh.ply", "sparse"]


def test_the_new_folder_of_a_run_without_files_is_removed(tmp_path):
    with pytest.raises(ZeroDivisionError), held_output(tmp_path / "a" / "out", "result"):
        raise ZeroDivisionError
    assert held(tmp_path) == []
    (tmp_path / "mine").mkdir()
    with pytest.raises(ZeroDivisionError), held_output(tmp_path / "mine", "result"):
        raise ZeroDivisionError
    assert held(tmp_path) == ["mine"]
    assert held(tmp_path / "mine") == []


def test_an_interrupted_run_names_the_folder_of_its_stages(tmp_path):
    with pytest.raises(KeyboardInterrupt) as raised, held_output(tmp_path / "out", "result"):
        fill(tmp_path / "out" / STAGES, {"mesh.pt": "kept"}, KeyboardInterrupt())
    assert f"Finished stages are kept in {tmp_path}/out/{STAGES}" in raised.value.__notes__[0]
    assert held(tmp_path / "out") == [STAGES]
    write(tmp_path / "out", result("first"))  # no --overwrite: there is no result yet
    assert contents(tmp_path / "out") == result("first")


def test_inputs_in_the_result_folder_are_refused(out, tmp_path):
    (tmp_path / "link").symlink_to(out.parent)
    for path in (out, out / "sparse", out / "mesh.ply", tmp_path / "link" / "out" / "masks"):
        with pytest.raises(InputError, match="--sparse"):
            require_apart(out, {"--masks": None, "--sparse": path})
    with pytest.raises(InputError, match="photographs"):
        require_apart(tmp_path / "link" / "out", {"photographs": out})
    require_apart(out, {"photographs": out.parent, "--mesh": tmp_path / "mesh.ply"})
    require_apart(tmp_path / "new", {"photographs": tmp_path})
    with pytest.raises(InputError, match="--cache"):
        require_apart(tmp_path / "new", {"--cache": tmp_path / "new" / "cache"})


def test_a_name_that_is_not_utf_8_is_refused(tmp_path):
    with pytest.raises(OutputError, match=r"\\udcff: the name is not UTF-8"):
        prepare_output(tmp_path / "out\udcff", "result")


def test_remains_of_a_run_killed_at_its_start_are_replaced(tmp_path):
    (tmp_path / "out" / STAGES).mkdir(parents=True)
    write(tmp_path / "out", result("first"))
    fill(tmp_path / "other" / STAGES, {"lock": "", "new/mesh.ply": "half"})
    write(tmp_path / "other", result("first"))
    for name in ("out", "other"):
        assert held(tmp_path / name) == [MARKER, "mesh.ply", "sparse"]
