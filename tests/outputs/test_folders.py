"""Folders of results: nothing is lost, nothing is half there, and two runs do not meet."""

import errno
import json
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from pimper_torch.errors import InputError, OutputError, PimperWarning
from pimper_torch.outputs import exchange as exchange_module
from pimper_torch.outputs import workspace as workspace_module
from pimper_torch.outputs.exchange import exchange
from pimper_torch.outputs.folders import held_output, prepare_output, require_apart, written_whole
from pimper_torch.outputs.marker import MARKER, STAGES, foreign, read_marker, remove_written, seal
from pimper_torch.outputs.workspace import READY, leftovers


def held(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def contents(folder: Path) -> dict[str, str]:
    """Every file of a result and what is in it, but not the list of them."""
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


def write_half(folder: Path, error: BaseException, *, overwrite: bool = False) -> None:
    with written_whole(folder, "result", overwrite=overwrite) as filled:
        fill(filled, {"mesh.ply": "half"})
        raise error


def keep(folder: Path, error: BaseException) -> None:
    """A run that fails after it has kept something."""
    with held_output(folder, "result"):
        (folder / STAGES / "mesh.pt").write_text("kept")
        raise error


def fill(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A folder with a result, in a folder of its own."""
    folder = tmp_path / "all" / "out"
    write(folder, result("first", "masks/a.png"))
    return folder


def test_the_marker_lists_what_was_written(out):
    marker = read_marker(out)
    assert marker.kind == "result"
    assert set(marker.files) == {"mesh.ply", "sparse/cameras.bin", "masks/a.png"}
    assert set(marker.folders) == {"sparse", "masks"}
    assert marker.files["mesh.ply"].size == len("first mesh.ply")
    assert foreign(out, marker) == []
    assert held(out) == [MARKER, "masks", "mesh.ply", "sparse"]


def test_a_result_is_replaced_on_demand_alone(out):
    with pytest.raises(OutputError, match=r"already holds masks, mesh\.ply, sparse"):
        write(out, result("second"))
    write(out, result("second"), overwrite=True)
    assert contents(out) == result("second")  # and the mask is gone
    assert held(out.parent) == ["out"]


@pytest.mark.parametrize("name", ["notes.txt", "sparse/mine.txt", "masks/old/b.png", "new/"])
def test_a_persons_own_file_anywhere_in_a_result_is_named_and_stays(out, name):
    path = out / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if name.endswith("/"):
        path.mkdir()
    else:
        path.write_text("years of work")
    before = contents(out)
    with pytest.raises(OutputError, match=name.strip("/").split("/")[-1].replace(".", r"\.")):
        write(out, result("second"), overwrite=True)
    assert contents(out) == before
    assert path.exists()


def test_a_file_of_ours_that_a_person_has_changed_stays(out):
    mask = out / "masks" / "a.png"
    mask.write_text("first masks/A.png")  # of the same size
    with pytest.raises(OutputError, match=r"masks/a\.png \(changed since it was written\)"):
        write(out, result("second"), overwrite=True)
    assert mask.read_text() == "first masks/A.png"


def test_a_copy_of_a_result_is_a_result(out, tmp_path):
    shutil.copytree(out, tmp_path / "copy", copy_function=shutil.copyfile)  # with other times
    write(tmp_path / "copy", result("second"), overwrite=True)
    assert contents(tmp_path / "copy") == result("second")


def test_a_link_in_the_place_of_a_file_of_ours_is_not_followed(out, tmp_path):
    (tmp_path / "mine.ply").write_text("first mesh.ply")
    (out / "mesh.ply").unlink()
    (out / "mesh.ply").symlink_to(tmp_path / "mine.ply")
    with pytest.raises(OutputError, match=r"holds mesh\.ply"):
        write(out, result("second"), overwrite=True)
    shutil.rmtree(out / "sparse")
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse" / "cameras.bin").write_text("first sparse/cameras.bin")
    (out / "sparse").symlink_to(tmp_path / "sparse")
    with pytest.raises(OutputError, match="sparse"):
        write(out, result("second"), overwrite=True)
    assert (tmp_path / "sparse" / "cameras.bin").exists()


def test_names_alone_make_no_result(tmp_path):
    fill(tmp_path / "proj", result("a person's"))
    with pytest.raises(OutputError, match=r"no list of what a former run wrote"):
        write(tmp_path / "proj", result("second"), overwrite=True)
    assert contents(tmp_path / "proj") == result("a person's")


def test_a_folder_of_another_kind_is_not_replaced(out):
    with pytest.raises(OutputError, match="holds a result, and is not overwritten by a scene"):
        prepare_output(out, "scene", overwrite=True)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: [],
        lambda content: content | {"format": "another"},
        lambda content: content | {"format_version": 2},
        lambda content: content | {"kind": "letters"},
        lambda content: content | {"files": ["mesh.ply"]},
        lambda content: content | {"files": {"mesh.ply": [1]}},
        lambda content: content | {"files": {"mesh.ply": [1, 2, 3]}},
        lambda content: content | {"files": {"../mine.txt": content["files"]["mesh.ply"]}},
        lambda content: content | {"files": {"/etc/passwd": content["files"]["mesh.ply"]}},
        lambda content: content | {"files": {"a//b": content["files"]["mesh.ply"]}},
        lambda content: content | {"files": {f"{STAGES}/lock": content["files"]["mesh.ply"]}},
        lambda content: content | {"folders": [3]},
        lambda content: content | {"folders": ["sparse/.."]},
    ],
)
def test_a_marker_that_is_wrong_or_leads_elsewhere_is_not_believed(out, change):
    content = json.loads((out / MARKER).read_text())
    (out / MARKER).write_text(json.dumps(change(content)))
    assert read_marker(out) is None
    with pytest.raises(OutputError, match="no list of what a former run wrote"):
        write(out, result("second"), overwrite=True)


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "\udcff", "null"])
def test_a_marker_that_is_no_json_is_not_believed(out, text):
    (out / MARKER).write_bytes(text.encode("utf-8", "surrogateescape"))
    assert read_marker(out) is None


def test_only_what_the_list_names_is_removed(out):
    marker = read_marker(out)
    (out / "sparse" / "mine.txt").write_text("mine")
    (out / "mesh.ply").write_text("changed!")
    remove_written(out, marker)
    assert contents(out) == {"mesh.ply": "changed!", "sparse/mine.txt": "mine"}


def test_kept_stages_survive_a_replacement_without_a_copy(out):
    for overwrite in (False, True):
        folder = out if overwrite else out.with_name("fresh")
        (folder / STAGES).mkdir(parents=True)
        fill(folder / STAGES, {"mesh.pt": "kept"})
        seal(folder / STAGES, "stages")
        number = (folder / STAGES / "mesh.pt").stat().st_ino
        write(folder, result("second"), overwrite=overwrite)
        assert (folder / STAGES / "mesh.pt").stat().st_ino == number
        assert contents(folder) == result("second")
    assert held(out.parent) == ["fresh", "out"]


def test_a_folder_of_stages_that_is_not_ours_is_refused(tmp_path):
    fill(tmp_path / "out" / STAGES, {"act_one.txt": "a play"})
    with pytest.raises(OutputError, match="which pimper did not make"):
        prepare_output(tmp_path / "out", "result", overwrite=True)
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / STAGES).symlink_to(tmp_path / "out" / STAGES)
    with pytest.raises(OutputError, match="which pimper did not make"):
        prepare_output(tmp_path / "linked", "result")


def test_the_former_result_is_whole_until_the_new_one_is(out, monkeypatch):
    """Whenever folders change their names, one of the two results stands in the place."""
    seen, change = [], workspace_module.exchange

    def watched(one, other, spare):
        seen.append(contents(out))
        change(one, other, spare)
        seen.append(contents(out))

    monkeypatch.setattr(workspace_module, "exchange", watched)
    write(out, result("second"), overwrite=True)
    first, second = result("first", "masks/a.png"), result("second")
    assert seen == [first, second, second, second]


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt()])
def test_what_fails_leaves_the_former_result_and_nothing_else(out, tmp_path, error):
    for folder, overwrite in ((out, True), (tmp_path / "new" / "deep", False)):
        with pytest.raises((OutputError, KeyboardInterrupt)) as raised:
            write_half(folder, error, overwrite=overwrite)
        if isinstance(error, OSError):
            assert "No space left" in str(raised.value)
            assert "writing failed" in str(raised.value)
    assert contents(out) == result("first", "masks/a.png")
    assert held(out.parent) == ["out"]
    assert held(tmp_path) == ["all"]


def test_a_disk_that_is_full_while_the_list_is_written_changes_nothing(out, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pimper_torch.outputs.folders.seal", full)
    with pytest.raises(OutputError, match="No space left"):
        write(out, result("second"), overwrite=True)
    assert contents(out) == result("first", "masks/a.png")
    assert held(out.parent) == ["out"]


def test_folders_change_their_names_also_one_by_one(tmp_path, monkeypatch):
    monkeypatch.setattr(exchange_module, "_call", lambda: None)
    (tmp_path / "one").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "one" / "a").touch()
    exchange(tmp_path / "one", tmp_path / "other", tmp_path / "spare")
    assert (held(tmp_path / "one"), held(tmp_path / "other")) == ([], ["a"])
    assert held(tmp_path) == ["one", "other"]
    with pytest.raises(OSError, match="nowhere"):
        exchange(tmp_path / "one", tmp_path / "nowhere", tmp_path / "spare")
    assert held(tmp_path) == ["one", "other"]


def busy(*_):
    raise OSError(errno.EBUSY, "Device or resource busy")


def test_a_folder_that_cannot_be_renamed_is_filled(out, monkeypatch):
    monkeypatch.setattr(workspace_module, "exchange", busy)
    number = out.stat().st_ino
    write(out, result("second", "lights.json"), overwrite=True)
    assert out.stat().st_ino == number
    assert contents(out) == result("second", "lights.json")
    assert held(out) == [MARKER, "lights.json", "mesh.ply", "sparse"]
    assert held(out.parent) == ["out"]


def test_the_folder_where_one_is_stays_the_folder_where_one_is(out, monkeypatch):
    monkeypatch.chdir(out)
    write(Path(), result("second"), overwrite=True)
    assert contents(Path()) == contents(out) == result("second")


def test_a_filling_that_was_cut_off_goes_on(out, monkeypatch):
    """Whichever renaming was the last one, the next run brings the new result to its place."""
    monkeypatch.setattr(workspace_module, "exchange", busy)
    new = result("second", "lights.json", "truth/a.txt")
    rename, count = Path.rename, 0

    def cut_off(path, target):
        nonlocal count
        if path.parent.name == READY:
            if count == 0:
                raise KeyboardInterrupt
            count -= 1
        return rename(path, target)

    for moved in range(4):
        folder = out.with_name(f"out{moved}")
        shutil.copytree(out, folder)
        count = moved
        with monkeypatch.context() as patched:
            patched.setattr(Path, "rename", cut_off)
            with pytest.raises(KeyboardInterrupt):
                write(folder, new, overwrite=True)
        assert (folder / STAGES / READY).is_dir()
        with held_output(folder, "result", overwrite=True):
            assert contents(folder) == new
        assert foreign(folder, read_marker(folder)) == []
        assert held(folder) == [MARKER, "lights.json", "mesh.ply", "sparse", "truth"]


def test_a_folder_that_may_be_written_though_the_one_above_may_not_is_filled(tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    mkdir = Path.mkdir

    def refuse(path, *given, **named):
        if path.parent == tmp_path:  # root may write anywhere
            raise PermissionError(13, "Permission denied")
        return mkdir(path, *given, **named)

    with monkeypatch.context() as patched:
        patched.setattr(
            Path,
            "mkdir",
            lambda path, *given, **named: (
                None if path == tmp_path / "out" else refuse(path, *given, **named)
            ),
        )
        write(tmp_path / "out", result("first"))
    assert contents(tmp_path / "out") == result("first")
    assert held(tmp_path / "out") == [MARKER, "mesh.ply", "sparse"]


HOLDS = """
import sys, time
from pathlib import Path
from pimper_torch.outputs.folders import held_output, written_whole
folder, mode = Path(sys.argv[1]), sys.argv[2]
with held_output(folder, "result", overwrite=True):
    (folder / ".stages" / "mesh.pt").write_text("kept")
    with written_whole(folder, "result", overwrite=True) as filled:
        (filled / "mesh.ply").write_text("half")
        print("ready", flush=True)
        time.sleep(60)
"""


def run_that_holds(folder: Path) -> "subprocess.Popen[str]":
    """Start a run that has written half of its result."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(folder), "sleep"], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def test_a_second_run_is_refused_and_a_killed_one_holds_nothing(out, tmp_path):
    for folder in (out, tmp_path / "fresh"):
        with run_that_holds(folder) as process:
            try:
                with pytest.raises(OutputError, match="another run writes there") as refused:
                    write(folder, result("second"), overwrite=True)
                told = str(refused.value)
                assert f"process {process.pid} on {os.uname().nodename} since 20" in told
                assert "sleep" in told  # its command
                (left,) = [p for p in folder.parent.iterdir() if p.name.startswith(".pimper-")]
                assert leftovers(folder.resolve()) == []  # it is alive
            finally:
                process.kill()
        assert leftovers(folder.resolve()) == [left]
        write(folder, result("second"), overwrite=True)
        assert contents(folder) == result("second")
        assert (folder / STAGES / "mesh.pt").read_text() == "kept"
        assert not left.exists()


def test_another_thread_is_refused_and_a_block_inside_is_not(tmp_path):
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
    assert "another run writes there" in refused[0]
    assert contents(tmp_path / "out") == result("first")


def test_a_run_killed_between_two_renamings_leaves_the_new_result(out, monkeypatch):
    monkeypatch.setattr(exchange_module, "_call", lambda: None)
    rename, new = Path.rename, result("second")
    fill(out / STAGES, {"mesh.pt": "kept"})
    seal(out / STAGES, "stages")

    def cut_off(path, target):
        if path.name == "new":
            raise KeyboardInterrupt
        if path.name == "spare":
            raise KeyboardInterrupt  # it is not put back: the process is dead
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", cut_off)
    monkeypatch.setattr(workspace_module, "_discard", lambda space: None)
    with pytest.raises(KeyboardInterrupt):
        write(out, new, overwrite=True)
    assert not out.exists()
    monkeypatch.undo()
    with held_output(out, "result", overwrite=True):
        assert contents(out) == new
    assert (out / STAGES / "mesh.pt").read_text() == "kept"
    assert held(out.parent) == ["out"]


def test_a_run_killed_after_the_exchange_leaves_the_new_result_and_what_was_kept(out, monkeypatch):
    fill(out / STAGES, {"mesh.pt": "kept"})
    seal(out / STAGES, "stages")
    change = workspace_module.exchange

    def once(one, other, spare):
        change(one, other, spare)
        raise KeyboardInterrupt

    monkeypatch.setattr(workspace_module, "exchange", once)
    monkeypatch.setattr(workspace_module, "_discard", lambda space: None)
    with pytest.raises(KeyboardInterrupt):
        write(out, result("second"), overwrite=True)
    monkeypatch.undo()
    assert contents(out) == result("second")
    with held_output(out, "result", overwrite=True):
        assert (out / STAGES / "mesh.pt").read_text() == "kept"
    assert contents(out) == result("second")
    assert held(out.parent) == ["out"]


@pytest.mark.filterwarnings("default::pimper_torch.errors.PimperWarning")
def test_a_file_that_comes_while_a_result_is_replaced_is_kept(out, monkeypatch):
    change = workspace_module.exchange

    def meanwhile(one, other, spare):
        (one / "letter.txt").write_text("dear") if one == out else None
        change(one, other, spare)

    monkeypatch.setattr(workspace_module, "exchange", meanwhile)
    with pytest.warns(PimperWarning, match="came into"):
        write(out, result("second"), overwrite=True)
    assert contents(out) == result("second")
    (kept,) = out.parent.rglob("letter.txt")
    assert kept.read_text() == "dear"


def test_a_file_that_comes_during_the_run_does_not_cost_the_result(out):
    (out.parent / "out-2").touch()
    with (
        pytest.raises(OutputError, match=r"letter\.txt.* The new result is in .*out-3\."),
        written_whole(out, "result", overwrite=True) as filled,
    ):
        fill(filled, result("second") | {"../../out/letter.txt": "dear"})
    assert contents(out) == result("first", "masks/a.png") | {"letter.txt": "dear"}
    assert contents(out.parent / "out-3") == result("second")
    write(out.parent / "out-3", result("third"), overwrite=True)  # it has its list


def test_a_hidden_folder_of_such_a_name_that_is_not_ours_stays(out):
    for name, note in ((".pimper-00000000", None), (".pimper-00000001", "{}"), (".pimper-a", None)):
        (out.parent / name).mkdir()
        (out.parent / name / "thesis.tex").write_text("years of work")
        if note is not None:
            (out.parent / name / "note.json").write_text(note)
    write(out, result("second"), overwrite=True)
    assert len(list(out.parent.rglob("thesis.tex"))) == 3


def test_a_folder_that_was_made_for_a_run_that_wrote_nothing_is_removed(tmp_path):
    with pytest.raises(ZeroDivisionError), held_output(tmp_path / "a" / "out", "result"):
        raise ZeroDivisionError
    assert held(tmp_path) == []
    (tmp_path / "mine").mkdir()
    with pytest.raises(ZeroDivisionError), held_output(tmp_path / "mine", "result"):
        raise ZeroDivisionError
    assert held(tmp_path) == ["mine"]
    assert held(tmp_path / "mine") == []


def test_a_run_that_kept_something_says_where_it_goes_on(tmp_path):
    with pytest.raises(KeyboardInterrupt) as raised:
        keep(tmp_path / "out", KeyboardInterrupt())
    assert f"What was finished is kept in {tmp_path}/out/{STAGES}" in raised.value.__notes__[0]
    assert held(tmp_path / "out") == [STAGES]
    write(tmp_path / "out", result("first"))  # no --overwrite: there is no result yet
    assert contents(tmp_path / "out") == result("first")


def test_inputs_in_the_folder_of_the_result_are_refused(out, tmp_path):
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


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="mounts need root")
def test_a_full_disk_and_a_mount_point(tmp_path):
    """A disk of 1 MB: what fits is there, what does not leaves the former result."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)], capture_output=True
    )
    if mounted.returncode != 0:
        pytest.skip("no disk can be mounted here")
    try:
        write(disk, result("first"))  # the mount point itself
        write(disk, result("second"), overwrite=True)
        assert contents(disk) == result("second")
        write(disk / "out", result("first"))
        with pytest.raises(OutputError, match="No space left"):
            write(disk / "out", {"mesh.ply": "x" * (1 << 21)}, overwrite=True)
        assert contents(disk / "out") == result("first")
        assert held(disk / "out") == [MARKER, "mesh.ply", "sparse"]
        assert not [path for path in disk.iterdir() if path.name.startswith(".pimper-")]
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_what_a_run_left_that_was_killed_in_its_first_moment_is_ours(tmp_path):
    """Before it had marked the folder of stages, and before it had noted whose its folder is."""
    fill(tmp_path / "out" / STAGES, {"lock": "", f"{MARKER}.new": "{"})
    bare = tmp_path / ".pimper-0123abcd"
    fill(bare, {"note.json.new": "{", "lock": ""})
    os.utime(bare, (0, 0))
    write(tmp_path / "out", result("first"))
    assert held(tmp_path) == ["out"]
    assert held(tmp_path / "out") == [MARKER, "mesh.ply", "sparse"]
