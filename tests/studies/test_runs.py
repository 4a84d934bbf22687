"""Every study runs at its smallest size and prints a row of its table."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tables
from normal_integration import CREASED, PUBLISHED
from PIL import Image

from pimper_bench.scenes import SceneConfig, render_scene

STUDIES = Path(__file__).parents[2] / "benchmarks" / "studies"
GIVEN = "--sparse {scene}/truth/sparse --masks {scene}/masks"

# The arguments of each script, and the beginning of its last row.
RUNS = {
    "fleet": (
        "--out {out} --tiny --only jar-arc-soft --preset fast --tag now",
        "| jar-arc-soft | 0.",
    ),
    "silhouettes": ("{scene}/photos={scene}/masks", "| {scene}/photos | 8 | "),
    "speed": ("{scene} --preset fast " + GIVEN, "| all | "),
    "train_silhouettes": (
        "{out} --captures 2 --tests 1 --views 6 --size 160 120 --minutes 0.1",
        "| first | 1 | 0.",
    ),
    "training": ("{scene} --tasks normals --steps 1", "| normals | 1 | "),
}
# A row of each study of the tables, whose labels begin its line.
ROWS = {
    "comparison": "jar smoothed",
    "capture_modes": "arc of 50° textured",
    "ingredients": "the smoothed sparse cloud",
    "strangers": "one camera and exposure",
    "cameras": "features",
    "lights": "24 places, a light each",
    "priors": "jar smooth errors",
    "file_encodings": "linear no",
    "sfm": "skull, 26 COLMAP's",
    "walk": "30",
    "normal_integration": "creases supp_tent",
    "gamma": "sRGB 0.2",
    "gradients": "sweep",
    "gradient_cost": "factorize",
}
PARTS = {"bench_runs", "declared", "fleet_captures", "tables"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("studies") / "scene"
    return render_scene(
        "mug", folder, SceneConfig(num_views=8, width=240, height=180, table="patterned")
    )


def flat(folder: Path, *, depth: bool) -> None:
    """Write the normal map of a plane, with its depth if asked for."""
    folder.mkdir(parents=True)
    Image.new("RGB", (20, 16), (128, 128, 255)).save(folder / "normal_map.png")
    Image.new("L", (20, 16), 255).save(folder / "mask.png")
    if depth:
        np.savetxt(folder / "K.txt", [[90.0, 0, 9.5], [0, 90, 7.5], [0, 0, 1]])
        np.savez(folder / "depth_gt.npz", depth_gt=np.full((16, 20), 1500.0))


def test_all_studies_are_run():
    assert {*ROWS} == {*tables.NAMES} - {"growth"}  # its mesh is not in the repository
    assert {path.stem for path in STUDIES.glob("*.py")} == {*RUNS, *tables.NAMES} | PARTS


@pytest.mark.parametrize("study", RUNS)
def test_imports_of_a_study_exist(study):
    assert "__doc__" in runpy.run_path(str(STUDIES / f"{study}.py"), run_name="imported")


def printed(study, arguments, folder):
    ran = subprocess.run(
        [sys.executable, STUDIES / f"{study}.py", *arguments],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "PIMPER_DATA": str(folder)},
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.splitlines()


@pytest.mark.slow
@pytest.mark.parametrize("study", RUNS)
def test_a_study_prints_its_table(study, scene, tmp_path):
    arguments, row = (text.format(scene=scene, out=tmp_path) for text in RUNS[study])
    lines = printed(study, arguments.split(), tmp_path)
    assert any(line.startswith(row) for line in lines), lines


@pytest.mark.slow
@pytest.mark.parametrize("study", ROWS)
def test_a_row_of_every_table_is_measured(study, tmp_path):
    for name in CREASED:
        flat(tmp_path / "normal_integration" / name, depth=False)
    for name in PUBLISHED:
        flat(tmp_path / "normal_integration" / "diligent" / name, depth=True)
    options = ["--only", ROWS[study], "--tiny", "--cache", str(tmp_path / "cache")]
    lines = printed("tables", [study, *options], tmp_path)
    assert any(line.startswith(f"{study}: ") and "CPU s" in line for line in lines), lines
    assert sum(line.startswith("| ") for line in lines) > len(tables.study_named(study).tables)
