"""A second run with other options of files or units computes only what these change."""

import json
import os
import re

import pytest
from command_line import small_run

from pimper_torch.cli.main import main
from pimper_torch.io.photograph_files import list_images
from pimper_torch.store import actual, deferred, digest, tensor_hash

pytestmark = pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")

PRESET = "scales: [0.5]\nsweep: {min_views: 2, num_views: 4}\nextract: {max_expected_error: 9}\n"
BAR = ["--scale-bar", "view_000,32,24", "view_001,30,20", "25"]


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """Arguments of a run on a small ball, whose records are kept in one folder."""
    folder = tmp_path_factory.mktemp("ball")
    arguments = small_run(folder, PRESET)
    assert main([*arguments, "-o", str(folder / "first"), "--cache", str(folder / "kept")]) == 0
    return arguments, folder / "kept"


def run_into(out, arguments, *more):
    assert main([*arguments, "-o", str(out), *map(str, more)]) == 0
    return json.loads((out / "summary.json").read_text())


def computed(summary):
    aside = {"import", "hash", "keep", "between stages", "compile", "judge_textures"}
    return {one["name"] for one in summary["stages"] if not one["kept"]} - aside


def content(out):
    """Return all files by name, without the times of the run."""
    times = rb'"(seconds|peak_memory_mb|kept|\w+_seconds|peak_memory_stage)": [^,}\]]+'
    lines = rb'\{\s*"name": "(hash|keep|between stages|import|photographs|compile)"[^}]*\},?\s*'
    files = {path.relative_to(out).as_posix(): path for path in out.rglob("*") if path.is_file()}
    texts = {"summary.json", "report.html"}
    found = {
        name: re.sub(lines, b"", re.sub(times, b"", path.read_bytes().replace(b"\n", b"")))
        if name in texts
        else path.read_bytes()
        for name, path in files.items()
        if ".stages" not in name
    }
    return {name: re.sub(rb"\s+", b" ", data) for name, data in found.items()}


@pytest.mark.parametrize(
    ("options", "runs"),
    [
        (["--stl", "--obj", "--asset-cameras", "--texture", "webp", *BAR], set()),
        (["--watertight", "--unit", "cm"], {"simplify"}),
        (["--faces", "60"], {"simplify", "photographs", "relight", "texture", "judge", "draw"}),
    ],
)
def test_a_kept_run_writes_the_files_of_a_new_one(line, tmp_path, options, runs):
    arguments, kept = line
    again = run_into(tmp_path / "out", arguments, *options, "--cache", kept)
    files = content(tmp_path / "out")
    (tmp_path / "out").rename(tmp_path / "again")
    fresh = run_into(tmp_path / "out", arguments, *options, "--cache", tmp_path / "kept")
    expected = content(tmp_path / "out")
    assert files.keys() == expected.keys()
    for name, data in expected.items():
        assert files[name] == data, name
    assert computed(again) == {*runs, "scale", "write"}
    assert {"read", "photometry", "relight", "draw"} <= computed(fresh)


def test_changed_photographs_and_settings_are_not_found(line, tmp_path):
    arguments, kept = line
    photographs = tmp_path / "photos"
    photographs.mkdir()
    for path in list_images(arguments[1]):
        (photographs / path.name).write_bytes(path.read_bytes())
    changed = [arguments[0], str(photographs), *arguments[2:]]
    run_into(tmp_path / "one", changed, "--cache", kept)
    assert "read" not in computed(run_into(tmp_path / "two", changed, "--cache", kept))
    os.utime(photographs / "view_003.png", ns=(1, 1))
    assert "read" in computed(run_into(tmp_path / "three", changed, "--cache", kept))
    assert "read" in computed(run_into(tmp_path / "four", changed, "--cache", kept, "--fresh"))
    settings = ["--extract.max-hole", "0.3"]
    assert "read" in computed(run_into(tmp_path / "five", changed, "--cache", kept, *settings))


def test_held_out_photographs_are_not_part_of_a_kept_result(line, tmp_path):
    arguments, kept = line
    for name in ("one", "two"):
        summary = run_into(tmp_path / name, arguments, "--cache", kept, "--hold-out", 2)
        assert "read" in computed(summary)


def test_a_deferred_tensor_has_the_hash_of_the_one_that_it_stands_for(reconstruction):
    images, read = reconstruction.scene.views.images, []
    later = deferred(images.shape, tensor_hash(images), lambda: read.append(1) or images)
    scene = reconstruction.scene
    waiting = scene.replace(views=scene.views.replace(images=later))
    assert digest(waiting) == digest(scene)
    assert read == []
    assert bool(waiting.views.images.isnan().all())
    (found,) = actual((waiting,))
    assert found.views.images is images
    assert actual(scene) is scene
