import json

import pytest
import torch
from torch.testing import assert_close

from pimper_bench.baselines.missing import MissingProgramError
from pimper_bench.metrics import TrueSurface
from pimper_bench.metrics.estimates import Estimate
from pimper_bench.metrics.in_view import meet_truth
from pimper_bench.scenes import SceneObject, render_objects, sparse_scene
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.scene_lights import wandering_lights
from pimper_bench.scenes.textures import random_speckle
from pimper_bench.table import run_bench as runner
from pimper_bench.table.bench_inputs import BenchConfig, Inputs, MethodRun, method_named
from pimper_bench.table.contact_sheet import error_along_rays
from pimper_bench.table.run_bench import BENCH_NAMES, run_bench
from pimper_bench.truth import Capture, Truth
from pimper_torch.export.result_folder.marker import MARKER
from pimper_torch.geometry.rigid import transform
from pimper_torch.io.meshes import read_mesh
from pimper_torch.records import CoarseMesh, Mesh
from pimper_torch.runtime.errors import ConfigError, PimperWarning, ReconstructionError

COUNTS = {"samples": 1000, "missing_samples": 250}
RIGHT = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def ball():
    """A ball in five cameras: its truth, and a scene like that of structure from motion."""
    generator = torch.Generator().manual_seed(91)
    vertices, faces = icosphere(4)
    mesh = Mesh(vertices_world=vertices, faces=faces, normals_world=vertices)
    cameras = arc_cameras(5, width=60, height=45, focal_px=80.0, distance=4.0)
    lights = wandering_lights(5, generator, distance=5.0)
    texture = random_speckle(generator, cells=(0.3,))
    scene = render_objects([SceneObject(mesh=mesh, texture=texture)], cameras, lights, generator)
    numbers = torch.arange(5)
    capture = Capture(
        views=scene.views,
        cameras=cameras,
        truth=Truth(mesh=mesh),
        position=numbers,
        light=numbers,
    )
    maps = Capture(
        views=scene.views.take([2]),
        cameras=cameras.take([2]),
        truth=Truth(
            mesh=mesh,
            depth=scene.depth[[2]],
            normals_world=scene.normals_world[[2]],
            albedo=scene.albedo[[2]],
            foreground=scene.foreground[[2]],
        ),
        position=numbers[[2]],
        light=numbers[[2]],
    )
    return Inputs(
        scene=sparse_scene(scene, 60, generator),
        coarse=CoarseMesh(
            mesh=mesh, reference=2, is_point=torch.ones(len(vertices), dtype=torch.bool)
        ),
        capture=capture,
        surface=TrueSurface(capture, samples=5_000),
        maps=maps,
        sfm_seconds=30.0,
    )


def of_radius(radius):
    """Return a method that returns a ball of the given radius; the true one is 1."""

    def method(scene, coarse):
        mesh = coarse.mesh.replace(vertices_world=radius * coarse.mesh.vertices_world)
        estimate = Estimate(
            mesh=mesh,
            names=scene.views.names,
            cameras=scene.cameras,
            reference=scene.views.names[coarse.reference],
        )
        return MethodRun(estimate=estimate, seconds=6.0, counts=COUNTS)

    return method


def config_of(*methods, scenes=("ball",)):
    return BenchConfig(samples=3000, scenes=scenes, methods=methods)


def failing(error):
    def method(scene, coarse):
        raise error

    return method


@pytest.fixture
def staged(monkeypatch, ball):
    """Replace rendering, structure from motion, and the methods by name."""
    methods = {
        "exact": of_radius(1.0),
        "larger": of_radius(1.02),
        "lost": failing(ReconstructionError("nothing was found")),
        "absent": failing(MissingProgramError("get it somewhere")),
    }
    monkeypatch.setattr(runner, "scene_folder", lambda scene, config, workspace: workspace)
    monkeypatch.setattr(runner, "prepare", lambda folder, config, cache: ball)
    monkeypatch.setattr(runner, "method_named", methods.__getitem__)
    return methods


def test_methods_are_measured_equally_and_failures_have_rows(staged, tmp_path):
    table = run_bench(config_of("exact", "larger", "lost", "absent"), tmp_path / "out")
    exact, larger, lost, absent = table.rows
    assert exact.relative_error < 0.02  # float32 rays
    assert exact.mean_normal_deg < 0.5  # the true normals are interpolated
    assert (exact.minutes, exact.sfm_minutes) == (0.1, 0.5)
    assert (exact.samples, exact.missing_percent) == (1000, 25.0)
    assert_close(exact.coverage_percent, 100.0)
    # A radial error of 0.02 everywhere, in per cent of the bounding cube's diagonal.
    diagonal = 2 * 3**0.5
    assert_close(larger.accuracy, 100 * 0.02 / diagonal, rtol=0.02, atol=0)
    assert_close(larger.completeness_seen, 100 * 0.02 / diagonal, rtol=0.02, atol=0)
    assert_close(larger.chamfer, 100 * 0.02 / diagonal, rtol=0.02, atol=0)
    assert dict(larger.f_scores)[0.5] == 0.0
    assert dict(larger.f_scores)[1.0] == 100.0
    assert "nothing was found" in lost.note
    assert absent.note.startswith("not installed")
    assert lost.relative_error is None


def test_figures_of_common_pixels_are_next_to_those_of_each_method(staged, tmp_path):
    def half(scene, coarse):
        outcome = of_radius(1.0)(scene, coarse)
        mesh = outcome.estimate.mesh
        # Without the side that is oblique in the reference camera.
        kept = (mesh.vertices_world[mesh.faces].mean(dim=1) @ RIGHT) > 0
        mesh = mesh.replace(faces=mesh.faces[kept], normals_world=mesh.vertices_world)
        return outcome.replace(estimate=outcome.estimate.replace(mesh=mesh))

    staged["half"] = half
    part, larger, lost = run_bench(config_of("half", "larger", "lost"), tmp_path / "out").rows
    assert 30 < part.coverage_percent < 70
    assert larger.coverage_percent == 100.0
    assert part.common_percent == larger.common_percent == part.coverage_percent
    assert_close(part.common_relative_error, part.relative_error, atol=1e-4, rtol=0)
    assert_close(part.common_mean_normal_deg, part.mean_normal_deg, atol=1e-3, rtol=0)
    assert larger.common_relative_error > 1
    assert abs(larger.common_relative_error - larger.relative_error) > 0.01
    assert lost.common_percent is None
    (alone,) = run_bench(config_of("larger"), tmp_path / "alone").rows
    assert alone.common_percent == alone.coverage_percent
    assert alone.common_relative_error == alone.relative_error


def test_the_folder_has_table_sheet_and_surfaces(staged, tmp_path):
    table = run_bench(config_of("larger", "lost"), tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(
        [*BENCH_NAMES, MARKER]
    )
    rows = json.loads((tmp_path / "out" / "table.json").read_text())["rows"]
    assert [row["method"] for row in rows] == [row.method for row in table.rows]
    assert "larger" in (tmp_path / "out" / "table.md").read_text()
    mesh = read_mesh(tmp_path / "out" / "meshes" / "ball_larger.ply")
    radii = mesh.vertices_world.norm(dim=1)
    assert_close(radii, torch.full_like(radii, 1.02), rtol=0, atol=1e-4)


@pytest.fixture
def fails(monkeypatch, ball):
    """Make the preparation of scenes fail from a given one on."""

    def let(error, first):
        scenes = iter(range(9))

        def prepare(folder, config, cache):
            if next(scenes) == first:
                raise error
            return ball

        monkeypatch.setattr(runner, "prepare", prepare)

    return let


@pytest.mark.usefixtures("staged")
def test_complete_scenes_survive_an_interruption(fails, tmp_path):
    fails(KeyboardInterrupt(), 1)
    with pytest.warns(PimperWarning, match="two"):
        table = run_bench(config_of("exact", scenes=("one", "two")), tmp_path / "out")
    assert [row.scene for row in table.rows] == ["one"]
    assert (tmp_path / "out" / "table.md").is_file()
    fails(KeyboardInterrupt(), 0)
    with pytest.raises(KeyboardInterrupt):
        run_bench(config_of("exact"), tmp_path / "other")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.usefixtures("staged")
def test_a_scene_without_cameras_has_a_row_for_every_method(fails, tmp_path):
    fails(ReconstructionError("no view was registered"), 0)
    table = run_bench(config_of("exact", "larger"), tmp_path / "out")
    assert [row.method for row in table.rows] == ["exact", "larger"]
    assert all("no view" in row.note for row in table.rows)


def test_ray_errors_are_in_per_cent_of_the_diagonal(ball):
    shift = torch.eye(4).double()
    camera = ball.maps.cameras.cam_from_world[0]
    shift[:3, 3] = 0.03 * camera[2, :3]  # away from the camera
    mesh = ball.capture.truth.mesh
    moved = mesh.replace(vertices_world=transform(shift, mesh.vertices_world))
    error = error_along_rays(meet_truth(moved, ball.maps, 0), ball.maps)
    foreground = ball.maps.truth.foreground[0]
    assert torch.equal(error.isnan(), ~foreground)
    centre = error[22, 30]
    assert_close(centre, torch.tensor(100 * 0.03 / (2 * 3**0.5)).double(), rtol=0.02, atol=0)
    half = mesh.replace(faces=mesh.faces[mesh.vertices_world[mesh.faces].mean(dim=1)[:, 0] > 0])
    missed = error_along_rays(meet_truth(half, ball.maps, 0), ball.maps).isinf()
    assert 0.3 < missed[foreground].float().mean() < 0.7


def test_unknown_methods_are_refused():
    with pytest.raises(ConfigError, match="smoothed"):
        method_named("defautl")


def test_presets_and_rivals_have_names():
    for name in BenchConfig(scale="full").chosen_methods:
        assert callable(method_named(name))
    assert set(BenchConfig().chosen_methods) < set(BenchConfig(scale="full").chosen_methods)
    assert BenchConfig(methods=("paper",)).chosen_methods == ("paper",)


@pytest.mark.parametrize(
    "wrong",
    [
        {"scenes": ()},
        {"methods": ("paper", "paper")},
        {"methods": ("default", "mine/default.yaml")},  # both have the same name in the table
        {"methods": ()},
        {"processes": 0},
        {"seed": -1},
    ],
)
def test_inconsistent_settings_of_a_table_are_refused(wrong):
    with pytest.raises(ConfigError):
        BenchConfig(**wrong)
