"""Every study runs at its smallest size and prints a row of its table."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from normal_integration import PUBLISHED
from PIL import Image

from pimper_bench.scenes import SceneConfig, render_scene

STUDIES = Path(__file__).parents[2] / "benchmarks" / "studies"
GIVEN = "--sparse {scene}/truth/sparse --masks {scene}/masks"

# The arguments of each study, and the beginning of its last row.
RUNS = {
    "coarse": ("{scene}", "| scene | Poisson of points and contours |"),
    "file_encodings": ("{scene} -o {out} --encodings sRGB", "| sRGB | no | "),
    "fleet": (
        "--out {out} --tiny --only jar-arc-soft --preset fast --tag now",
        "| jar-arc-soft | 0.",
    ),
    "gamma": ("--curves sRGB --noise 0.01 --seeds 1", "| sRGB | 0.2 | 4 | 1.0 | 2."),
    "gradient_cost": ("{scene} --scales 0.25 --only repair", "| repair | "),
    "gradients": (
        "--scales 1 --only repair --directions 1",
        "| repair | vertices | ",
    ),
    "guards": (
        "{out} --tiny --presets fast --sets potatoes-arc --key now",
        "| silhouettes.empty | photographs | fast | ",
    ),
    "normal_integration": ("{out}", "| flat | discontinuities | "),
    "priors": ("{scene} --kinds none", "| scene | none | "),
    "sfm": ("{scene}/photos --truth {scene} --only ours:", "| ours: tracks found again | 8 of 8 |"),
    "silhouettes": ("{scene}/photos={scene}/masks", "| {scene}/photos | 8 | "),
    "speed": ("{scene} --preset fast " + GIVEN, "| all | "),
    "strangers": ("{out} --num-views 8 --width 320 --sets one", "| one | "),
    "train_silhouettes": (
        "{out} --captures 2 --tests 1 --views 6 --size 160 120 --minutes 0.1",
        "| first | 1 | 0.",
    ),
    "training": ("{scene} --tasks normals --steps 1", "| normals | 1 | "),
    "turntable": ("{scene} --masks none", "| scene | none | 8 of 8 | "),
    "walk": ("--num-views 8 --width 240 --height 180 --renderings {out}", "| 8 | "),
}


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
    assert {path.stem for path in STUDIES.glob("*.py")} == {*RUNS, "fleet_captures", "guard_sets"}


@pytest.mark.parametrize("study", RUNS)
def test_imports_of_a_study_exist(study):
    assert "__doc__" in runpy.run_path(str(STUDIES / f"{study}.py"), run_name="imported")


@pytest.mark.slow
@pytest.mark.parametrize("study", RUNS)
def test_a_study_prints_its_table(study, scene, tmp_path):
    arguments, row = (text.format(scene=scene, out=tmp_path) for text in RUNS[study])
    if study == "normal_integration":
        flat(tmp_path / "flat", depth=False)
        for name in PUBLISHED:
            flat(tmp_path / "diligent" / name, depth=True)
    ran = subprocess.run(
        [sys.executable, STUDIES / f"{study}.py", *arguments.split()],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    assert any(line.startswith(row) for line in ran.stdout.splitlines()), ran.stdout
