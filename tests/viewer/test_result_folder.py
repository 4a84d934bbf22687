"""A folder of results, from the command that wrote it to the page."""

import json
import os
import signal
import subprocess
import sys
from urllib.request import urlopen

import pytest
import torch
from surfaces import surface_of

from pimper_torch.chains.coarse_to_fine import CoarseToFineConfig
from pimper_torch.cli.main import main
from pimper_torch.errors import InputError, PimperWarning
from pimper_torch.evidence.scenes.procedural_meshes import icosphere
from pimper_torch.io import results
from pimper_torch.io.meshes import write_ply
from pimper_torch.journal import Journal, current, writing
from pimper_torch.records import Mesh, StageReport
from pimper_torch.store import Store, kept
from pimper_torch.viewer.show import add_folder, passes_kept, show

pytest.importorskip("viser")


def report(name, seconds):
    return StageReport(name=name, seconds=seconds, peak_memory_mb=9.0, figures={})


def surface(reconstruction, shift):
    """The result's mesh as the surface of a pass, moved by a shift."""
    mesh = reconstruction.mesh
    return surface_of(
        mesh.vertices_world + shift,
        mesh.faces,
        normals_world=mesh.normals_world,
        albedo=mesh.albedo,
        height_information=torch.ones(len(mesh.vertices_world)),
    )


@pytest.fixture
def folder(reconstruction, tmp_path, small_pictures):
    """A folder of results of three passes, whose photographs are gone, with what the run kept."""
    stages = [report("coarse_surface", 1.5), *(report("fuse", one) for one in (2.5, 3.5, 4.5))]
    run = reconstruction.replace(report=tuple(stages))
    about = {"photographs": str(tmp_path / "gone"), "masks": None}
    results.write_result(run, CoarseToFineConfig(), tmp_path / "out", about=about)
    store = Store(folder=tmp_path / "out" / ".stages")
    keep(store, "coarse_surface-a", run.coarse, stages[0])
    for number, stage in enumerate(stages[1:]):
        keep(store, f"fuse-{number}", surface(run, number), stage)
    keep(store, "fuse-of-another-run", surface(run, 9), report("fuse", 7.5))
    return tmp_path / "out"


def keep(store, key, record, stage):
    """Keep a record as a run does, with its stage's report beside a caution."""

    def make():
        current().tell("a caution")
        current().tell(stage)
        return record

    with writing(Journal(events=[])):
        kept(store, key, type(record), make)


def test_passes_of_this_result_are_read_in_their_order(folder, reconstruction):
    summary = json.loads((folder / "summary.json").read_text())
    found = dict(passes_kept(folder, summary))
    assert [*found] == ["coarse surface", "pass 1", "pass 2"]  # the last one is the result
    moved = found["pass 2"].vertices_world - reconstruction.mesh.vertices_world
    torch.testing.assert_close(moved, torch.ones_like(moved))
    sized = dict(passes_kept(folder, {**summary, "scale": {"factor": 10.0, "unit": "mm"}}))
    torch.testing.assert_close(
        sized["pass 1"].vertices_world, 10 * reconstruction.mesh.vertices_world
    )


def test_without_its_photographs_the_rest_is_shown_and_said(viewer, folder):
    with pytest.warns(PimperWarning, match="shows no photographs"):
        add_folder(viewer, folder)
    scene = viewer.server.scene
    assert scene.get_handle_by_name("/surface") is not None
    assert scene.get_handle_by_name("/cameras/00002") is not None
    assert scene.get_handle_by_name("/photographs/00002") is None
    assert viewer._photographs.disabled
    assert viewer._pass.max == 3


def test_a_folder_without_a_surface_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"mesh\.ply"):
        show(tmp_path, port=0)


@pytest.fixture
def ball(tmp_path):
    vertices, faces = icosphere(2)
    write_ply(Mesh(vertices_world=vertices, faces=faces), tmp_path / "ball.ply")
    return tmp_path / "ball.ply"


def test_the_command_serves_a_page_until_ctrl_c(ball):
    code = "import sys; from pimper_torch.cli.supervise import main; sys.exit(main())"
    line = [sys.executable, "-c", code, "view", str(ball), "--port", "0", "--json"]
    # What runs in the background of a shell ignores Ctrl-C, and so does what it starts.
    with subprocess.Popen(
        line,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        for written in process.stdout:
            event = json.loads(written)
            if event["event"] == "view":
                break
        with urlopen(event["address"], timeout=10) as answer:
            assert answer.status == 200
        os.kill(process.pid, signal.SIGINT)
        assert process.stdout.read() == ""
        assert process.wait(timeout=30) == 0


@pytest.mark.parametrize(
    ("line", "needed"),
    [
        (["nowhere"], "found nothing"),
        (["{ball}", "--port", "70000"], "0 to 65535"),
        (["{ball}", "--host", "192.0.2.1"], "an address of this machine"),
    ],
)
def test_the_command_refuses(line, needed, ball, capsys):
    assert main(["view", *(word.format(ball=ball) for word in line)]) == 2
    assert needed in " ".join(capsys.readouterr().err.split())
