import errno
import io
import json
import math
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import warnings
import webbrowser
from pathlib import Path

import pytest
import torch
from command_line import run
from PIL import Image

import pimper_torch as pt
from pimper_torch.chains.chain import Step
from pimper_torch.cli.output import Output
from pimper_torch.export.result_folder.marker import MARKER, seal
from pimper_torch.export.results import RESULT_NAMES
from pimper_torch.io.meshes import write_ply
from pimper_torch.io.version import installed_version
from pimper_torch.records import Removal

ASKED_FOR = {  # optional files, not requested here
    *("masks", "mesh.stl", "mesh.obj", "asset.usdz"),
    *("asset.obj", "asset.mtl", "asset_albedo.png", "asset_normal.png"),
}


def held(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def reconstruct(photos, chain, tmp_path):
    """Run with a stand-in for the chain, into the folder `out`."""
    return lambda *given: run("reconstruct", photos, "-o", tmp_path / "out", *given)


def test_a_run_writes_the_result_and_prints_its_path(reconstruct, chain, tmp_path, capsys):
    assert reconstruct() == 0
    assert held(tmp_path / "out") == sorted({*RESULT_NAMES, MARKER, ".stages"} - ASKED_FOR)
    config, views, sparse = chain.given
    assert config == pt.CoarseToFineConfig() == pt.load_config("default")
    assert views.names == ("0.png", "1.png", "2.png", "3.png")
    assert sparse is None
    printed = capsys.readouterr()
    assert f"{tmp_path}/out/mesh.ply" in printed.out
    for stage in ("read", "warp", "write"):
        assert stage in printed.err
    assert "samples 1,200" not in printed.err
    verdict, place, took = printed.out.splitlines()
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert verdict == summary["verdict"]["text"]
    assert place.endswith(f"{tmp_path}/out/report.html shows it.")
    stages = tmp_path / "out" / ".stages"
    size = sum(path.stat().st_size for path in stages.glob("*.safetensors")) / 1e6
    expected = (
        rf"It took (\d+) s; {stages} keeps {size:.0f} MB for further runs, and `pimper clean "
    )
    (seconds,) = re.match(expected, took).groups()
    assert int(seconds) >= round(summary["seconds"]) - 1


@pytest.mark.parametrize("option", ["-v", "--verbose", "--log-level=debug"])
def test_the_table_and_figures_of_stages_are_shown_on_request(reconstruct, capsys, option):
    assert reconstruct(option) == 0
    printed = capsys.readouterr()
    assert "samples 1,200" in printed.err
    assert "stage             seconds   peak MB" in printed.out
    assert "3 of 4 photographs" in printed.out


@pytest.mark.parametrize(("given", "opened"), [([], 1), (["--no-report"], 0), (["--json"], 0)])
def test_the_report_is_opened_on_request(reconstruct, tmp_path, monkeypatch, given, opened):
    pages = []
    monkeypatch.setattr(webbrowser, "open", pages.append)
    assert reconstruct("--open", *given) == 0
    assert pages == [(tmp_path / "out" / "report.html").as_uri()] * opened
    assert reconstruct("--overwrite") == 0
    assert len(pages) == opened


def test_a_path_is_a_link_on_a_terminal_alone(monkeypatch, tmp_path):
    path = tmp_path / "a b.png"
    assert Output().link(path) == str(path)
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    uri = "file://" + str(path).replace(" ", "%20")
    assert Output().link(path) == f"\x1b]8;;{uri}\x1b\\{path}\x1b]8;;\x1b\\"


@pytest.mark.parametrize(
    ("given", "largest", "number"),
    [((), 1600, 1600), (("--max-size-px", "0"), 1700, 0), (("--max-size-px", "40"), 40, 40)],
)
def test_the_working_size_is_chosen_printed_and_written(
    photos, chain, tmp_path, capsys, given, largest, number
):
    with Image.open(photos / "1.png") as image:
        image.resize((1700, 400)).save(photos / "1.png")
    assert run("reconstruct", photos, "-o", tmp_path / "out", *given) == 0
    assert max(chain.given[1].images.shape[-2:]) == largest
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["max_size_px"] == number
    line = f"Photographs of up to 1700x400 are shrunk to {number} px (`--max-size-px`)."
    assert (line in capsys.readouterr().out) == (number > 0)


def test_a_run_ends_with_the_removals_of_guards(
    reconstruct, chain, reconstruction, tmp_path, capsys
):
    gone = Removal(
        guard="sfm.missing", what="photographs", count=1, total=4, reason="none", names=("3.png",)
    )
    reduced = reconstruction.replace(left_out=(gone,))
    chain.__call__ = lambda *_: reduced
    assert reconstruct("-v") == 0
    assert "Excluded: 3.png (sfm.missing)." in capsys.readouterr().out
    (written,) = json.loads((tmp_path / "out" / "summary.json").read_text())["left_out"]
    assert Removal(**{**written, "names": tuple(written["names"])}) == gone


def test_options_override_the_preset(photos, chain, tmp_path):
    preset = tmp_path / "mine.yaml"
    preset.write_text("reconstruct: {starts: 5, seed: 3}\n")
    for place, given in enumerate((["--preset", preset], [f"--preset={preset}"])):
        out = tmp_path / str(place)
        assert run("reconstruct", photos, "-o", out, *given, "--reconstruct.seed", "4") == 0
        settings = chain.given[0].reconstruct
        assert (settings.starts, settings.seed) == (5, 4)


def test_masks_of_a_result_can_be_given_and_are_trusted(reconstruction, chain, tmp_path):
    """The silhouettes of a run are read back bit for bit and trusted, however they look."""
    scene = reconstruction.scene
    inside = torch.rand(3, 40, 60, generator=torch.Generator().manual_seed(4))
    reliable = torch.tensor([True, True, False])
    found = pt.Silhouettes(inside=inside, reliable=reliable, source="found")
    pt.write_result(
        reconstruction.replace(silhouettes=found), pt.CoarseToFineConfig(), tmp_path / "first"
    )
    photos = tmp_path / "photos"
    photos.mkdir()
    for name, image in zip(scene.views.names, scene.views.images, strict=True):
        pixels = (255 * image).byte().movedim(0, -1).expand(-1, -1, 3)
        Image.fromarray(pixels.numpy()).save(photos / name)
    masks = tmp_path / "first" / "masks"
    few = ("--factorize.min-views", "3")
    assert run("reconstruct", photos, "-o", tmp_path / "second", "--masks", masks, *few) == 0
    views = chain.given[1]
    assert views.names == scene.views.names
    silhouettes = pt.FindSilhouettes()(scene.replace(views=views))
    assert silhouettes.source == "masks"
    assert torch.equal(silhouettes.masks, found.masks)
    assert silhouettes.reliable.all()  # including views whose silhouette was unreliable


def test_the_demo_runs_on_the_photographs_of_the_package(chain, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("demo", "--max-size-px", "60") == 0
    assert held(tmp_path / "pimper_demo") == sorted({*RESULT_NAMES, MARKER, ".stages"} - ASKED_FOR)
    assert chain.given[1].num_views == 26
    assert "37.jpg" in chain.given[1].names


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--preset", "papre"], "Did you mean `paper`?"),
        (["--preset", "paper", "--max-memory=1GB"], "option of the preset paper, but of default"),
        (["--triangulate.reference", "9"], "is not an option of the preset default, but of "),
        (["--preset", "nowhere/mine.yaml"], "there is no such file"),
        (["--reconstruct.starts", "-1"], "starts is -1; needed: 0 or more"),
        (["--max-size-px", "-3"], "max_size_px is -3; needed: 0, or at least 32 pixels"),
        (
            ["--factorize.min-views", "5"],
            "photos: the number of photographs is 4; needed: at least",
        ),
        (
            ["--reference", "nosuch"],
            "'nosuch': no photographs have this name; needed: one of 0.png",
        ),
        (["--photographs.saturation", "x"], "is 'x'; needed: {auto}|FLOAT|FLOAT,FLOAT,FLOAT."),
        (["--scales", "x"], "--scales is 'x'; needed: FLOAT,.... Scale of the photographs"),
        (["--region", "1"], "--region is '1'; needed: FLOAT,.... Box around the object"),
        (["--masks", "nowhere"], "nowhere: found nothing; needed: a folder"),
        (["--sede", "3"], "Unrecognized options: --sede, 3"),
        (["--reconstruct.starts", "many"], "--reconstruct.starts is 'many'; needed: INT."),
        (["--log-level", "loud"], "--log-level is 'loud'; needed: one of error"),
        (["--log-level"], "--log-level is ''; needed: one of error"),
    ],
)
def test_a_user_error_is_one_message(reconstruct, chain, tmp_path, capsys, arguments, expected):
    assert reconstruct(*arguments) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert expected in message
    assert message.count("\n") == 1
    assert chain.given is None
    assert held(tmp_path) == ["photos"]


def test_an_occupied_out_is_refused_before_photographs_are_read(reconstruct, tmp_path, capsys):
    assert reconstruct() == 0
    assert run("reconstruct", tmp_path / "nowhere", "-o", tmp_path / "out") == 2
    assert "out: already contains albedo.png" in capsys.readouterr().err
    assert reconstruct("--overwrite") == 0
    assert held(tmp_path / "out") == sorted({*RESULT_NAMES, MARKER, ".stages"} - ASKED_FOR)


def test_a_missing_gpu_is_reported_before_the_run(reconstruct, chain, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert reconstruct("--device", "cuda") == 2
    assert "finds no CUDA device" in capsys.readouterr().err
    assert chain.given is None


def fail():
    raise pt.ReconstructionError("reconstruct: only 2 of 3 photographs [1, 2] registered.")


def interrupt():
    raise KeyboardInterrupt


def terminate():
    os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize(
    ("work", "kind", "code", "expected"),
    [
        (fail, "ReconstructionError", 2, "error: reconstruct: only 2 of 3 photographs [1, 2] regi"),
        (interrupt, "Interrupted", 130, "interrupted; no result was written"),
        (terminate, "Interrupted", 143, "interrupted; no result was written"),
    ],
)
def test_a_run_that_ends_early_leaves_no_files(
    reconstruct, chain, tmp_path, capsys, work, kind, code, expected
):
    former = signal.getsignal(signal.SIGTERM)
    chain.work = lambda self: work()
    assert reconstruct("--json") == code
    said = capsys.readouterr()
    assert expected in said.err
    last = json.loads(said.out.splitlines()[-1])
    assert (last["event"], last["kind"], last["exit_code"]) == ("error", kind, code)
    assert held(tmp_path) == ["photos"]
    assert signal.getsignal(signal.SIGTERM) is former


def test_warnings_are_sentences(reconstruct, chain, capsys):
    chain.work = warn
    usual = warnings.showwarning
    assert reconstruct() == 0
    assert "warning: light hardly varies.\n" in capsys.readouterr().err
    assert warnings.showwarning is usual


def test_help_names_the_commands_and_version_the_version(capsys):
    assert run("--help") == 0
    printed = capsys.readouterr().out
    assert "reconstruct PHOTOS -o OUT" in printed
    assert "\n  demo " in printed
    assert "130 interrupted" in printed
    assert run("--version") == 0
    lines = dict(line.split(" ", 1) for line in capsys.readouterr().out.splitlines())
    assert lines["pimper_torch"] == installed_version()
    assert lines["torch"] == torch.__version__
    assert {"kornia", "pycolmap", "Python", "system"} <= lines.keys()
    assert run() == 2


def test_a_misspelt_command_suggests_the_nearest(capsys):
    assert run("reconstuct") == 2
    assert "Did you mean `reconstruct`?" in capsys.readouterr().err


def test_a_folder_in_place_of_a_command_names_the_command(tmp_path, capsys):
    assert run(str(tmp_path)) == 2
    assert f"such as `pimper reconstruct {tmp_path} -o OUT`" in capsys.readouterr().err
    seal(tmp_path, "result")
    assert run(str(tmp_path)) == 2
    assert f"such as `pimper view {tmp_path}`" in capsys.readouterr().err


def test_a_folder_for_the_result_without_its_option_is_named(tmp_path, capsys):
    assert run("reconstruct", str(tmp_path), "there") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert said.startswith("error: there is not an option; needed: `-o there`, if it is for the")
    assert run("reconstruct", str(tmp_path), "--there") == 2
    assert "missing: -o OUT" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["reconstruct", "batch"])
def test_a_result_in_place_of_photographs_is_refused(command, tmp_path, capsys):
    (tmp_path / "result").mkdir()
    seal(tmp_path / "result", "result")
    assert run(command, str(tmp_path / "result"), "-o", str(tmp_path / "out")) == 2
    assert "is a result of `pimper reconstruct`" in " ".join(capsys.readouterr().err.split())


def test_unexpected_errors_are_reported_and_saved(
    reconstruct, chain, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    chain.work = lambda self: 1 / 0
    assert reconstruct("-q") == 1
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith("error: unexpected ZeroDivisionError: division by zero.")
    (kept,) = tmp_path.glob("pimper-*.txt")
    assert str(kept) in message
    text = kept.read_text()
    assert "Traceback" in text
    assert f"pimper_torch {installed_version()}" in text
    assert f"torch {torch.__version__}" in text
    assert shlex.join(sys.argv) in text  # the command line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/tmp/a.db"), "Free space."),
        (PermissionError(errno.EACCES, "Permission denied", "/root/x"), "/root/x: the system"),
        (MemoryError(), "memory ran out; no result was written."),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: 99 bytes"), "memory ran out"),
    ],
)
def test_system_errors_are_not_reported_as_bugs(
    reconstruct, chain, tmp_path, capsys, error, expected
):
    def refuse(_):
        raise error

    chain.work = refuse
    assert reconstruct() == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert expected in message
    assert "fault" not in message
    assert held(tmp_path) == ["photos"]


def test_an_unwritable_crash_report_is_reported(reconstruct, chain, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "nowhere"))
    chain.work = lambda self: 1 / 0
    assert reconstruct() == 1
    printed = capsys.readouterr().err
    assert "Traceback" in printed
    assert "Please send the traceback above" in printed


@pytest.mark.parametrize("place", ["out", "photos", "photograph"])
def test_names_that_are_not_utf_8_are_refused(photos, chain, tmp_path, capsys, place):
    strange = "caf\udce9"  # not UTF-8
    given = {"out": tmp_path / "out", "photos": photos}
    if place == "photograph":
        (photos / "0.png").rename(photos / f"{strange}.png")
    else:
        given[place] = tmp_path / strange
    assert run("reconstruct", given["photos"], "-o", given["out"]) == 2
    assert "caf\\udce9" in (printed := capsys.readouterr().err)
    assert "the name is not UTF-8" in printed
    assert chain.given is None


@pytest.mark.slow
def test_names_in_utf_8_are_written_in_any_locale(photos, tmp_path):
    """In the C locale Python uses UTF-8 for names, and so do its libraries."""
    folder = photos.rename(photos.with_name("h\u00e9"))
    (folder / "0.png").rename(folder / "\u00fc \u96ea.png")
    ran = subprocess.run(
        [sys.executable, "-m", "pimper_torch", "doctor", str(folder)],
        env=os.environ | {"LC_ALL": "C", "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        text=True,
    )
    assert ran.returncode in (0, 2)
    assert "unexpected" not in ran.stderr
    assert "Traceback" not in ran.stderr


def test_the_debug_log_level_shows_tracebacks(reconstruct, chain, capsys):
    chain.work = lambda self: fail()
    assert reconstruct("--log-level", "debug") == 2
    assert "Traceback" in capsys.readouterr().err


def warn(_):
    warnings.warn("light hardly varies.", pt.PimperWarning, stacklevel=1)


@pytest.mark.parametrize(("given", "warned"), [(["-q"], True), (["--log-level", "error"], False)])
def test_a_quiet_run_shows_only_warnings(reconstruct, chain, capsys, given, warned):
    chain.work = warn
    assert reconstruct(*given) == 0
    printed = capsys.readouterr()
    assert printed.out == ""
    assert all(line.startswith("warning: ") for line in printed.err.splitlines())
    assert ("warning: light hardly varies." in printed.err) is warned


def events(capsys):
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_events_are_one_json_object_per_line(reconstruct, chain, tmp_path, capsys):
    chain.work = warn
    assert reconstruct("--json") == 0
    printed = events(capsys)
    assert printed[0]["event"] == "start"
    assert printed[0]["command"] == "reconstruct"
    assert printed[0]["versions"]["pimper_torch"] == installed_version()
    for name in ("read", "warp", "write"):
        begun, ended = (
            next(n for n, one in enumerate(printed) if one == one | {"event": event, "stage": name})
            for event in ("stage-begin", "stage-end")
        )
        assert begun < ended
        assert printed[ended]["seconds"] >= 0
    (ended,) = [one for one in printed if one == one | {"event": "stage-end", "stage": "warp"}]
    assert ended["figures"] == {"samples": 1200}
    assert {"event": "progress", "stage": "read", "done": 4, "total": 4}.items() <= next(
        one for one in printed if one["event"] == "progress"
    ).items()
    assert "light hardly varies." in [one.get("message") for one in printed]
    assert printed[-1]["event"] == "result"
    assert printed[-1]["paths"]["mesh.ply"] == str(tmp_path / "out" / "mesh.ply")
    assert printed[-1]["figures"] == json.loads((tmp_path / "out" / "summary.json").read_text())
    moments = [one["elapsed"] for one in printed]
    assert moments == sorted(moments)
    begun = [one for one in printed if one["event"] == "stage-begin"]
    assert begun[0]["seconds_left"] is None  # no photograph has been read
    assert begun[-1]["stage"] == "write"
    assert 0 < begun[-1]["seconds_left"] < 10
    assert [one for one in printed if "seconds_left" in one][-1]["seconds_left"] == 0
    lines = [stage["name"] for stage in printed[-1]["figures"]["stages"]]
    assert (lines[0], lines[-2:]) == ("import", ["between stages", "write"])


def test_a_run_with_events_does_not_wait_for_the_viewer(reconstruct, chain, reconstruction, capsys):
    pytest.importorskip("viser")

    def show(self):
        self.watch(reconstruction.scene)
        self.preview(reconstruction.scene, reconstruction.coarse)

    chain.work = show
    assert reconstruct("--view", "--json") == 0
    printed = events(capsys)
    (page,) = [one for one in printed if one["event"] == "view"]
    assert page["address"].startswith("http://127.0.0.1:")
    assert printed[-1]["event"] == "result"


@pytest.mark.usefixtures("ctrl_c")
def test_a_run_with_a_viewer_stays_until_ctrl_c(reconstruct, chain, reconstruction, capsys):
    pytest.importorskip("viser")
    chain.work = lambda self: self.watch(reconstruction.scene)
    assert reconstruct("--view") == 0
    assert capsys.readouterr().out.rstrip().endswith("until Ctrl-C.")


def test_without_a_viewer_a_run_is_refused(reconstruct, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pimper_torch.viewer.server.find_spec", lambda _: None)
    assert reconstruct("--view") == 2
    assert "pip install 'pimper_torch[view]'" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def times(out):
    return {path: path.stat().st_mtime_ns for path in out.iterdir() if path.name != ".stages"}


def test_a_picture_of_what_is_found_is_there_until_the_run_ends(
    reconstruct, chain, reconstruction, tmp_path, capsys
):
    out, drawn = tmp_path / "out", []
    picture = out / ".stages" / "preview.png"
    assert reconstruct() == 0
    former = times(out)
    capsys.readouterr()
    fields = {"heights": reconstruction.patches, "surface": reconstruction}
    step = Step(scale=0.5, last=False, prepared=reconstruction, **fields)

    def show(self):
        drawn.clear()
        final = step.replace(last=True)
        for record in (reconstruction.scene, reconstruction.coarse, step, final):
            if record is reconstruction.coarse:
                self.preview(reconstruction.scene, record)
            else:
                self.watch(record)
            with Image.open(picture) as image:
                assert image.height == 360
            drawn.append(picture.read_bytes())

    def show_and_fail(self):
        show(self)
        assert times(out) == former
        raise pt.ReconstructionError("no surface.")

    chain.work = show_and_fail
    assert reconstruct("--json", "--overwrite", "--fresh") == 2
    printed = [one for one in events(capsys) if one["event"] == "preview"]
    assert [one["shows"] for one in printed] == ["points", "coarse surface", "pass 1"]
    assert {one["path"] for one in printed} == {str(picture)}
    assert len({*drawn}) == 3  # the last pass is not drawn
    assert times(out) == former
    chain.work = show
    assert reconstruct("--overwrite", "--fresh") == 0
    line = f"{picture} shows what is found so far, until the run ends."
    assert capsys.readouterr().out.count(line) == 1
    assert times(out).keys() == former.keys()
    assert not picture.exists()


def test_values_without_json_form_become_null_or_text(capsys):
    Output(as_json=True).event("result", figures={"a": math.inf, "b": [math.nan, Path("c")]})
    (printed,) = events(capsys)
    assert printed["figures"] == {"a": None, "b": [None, "c"]}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a disk that is always full")
def test_unwritable_output_gives_a_message(capsys, monkeypatch):
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert run("config", "default") == 2
        monkeypatch.undo()
    message = capsys.readouterr().err
    assert message.startswith("error: the system refuses (No space left on device)")
    assert "Traceback" not in message


def test_a_given_mesh_reaches_the_chain(reconstruct, photos, chain, tmp_path):
    square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    mesh = pt.Mesh(vertices_world=square, faces=torch.tensor([[0, 1, 2], [0, 2, 3]]))
    write_ply(mesh, tmp_path / "rough.ply")
    out = tmp_path / "out"
    assert reconstruct("--mesh", tmp_path / "rough.ply") == 0
    assert torch.equal(chain.mesh.faces, mesh.faces)
    assert json.loads((out / "summary.json").read_text())["mesh"] == str(tmp_path / "rough.ply")
    assert run("reconstruct", photos, "-o", tmp_path / "b", "--mesh", tmp_path / "none.ply") != 0
    assert not (tmp_path / "b").exists()
