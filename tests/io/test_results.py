import base64
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from torch.testing import assert_close

from pimper_bench.metrics.estimates import estimate_of, read_estimate
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.export import results
from pimper_torch.export.reports import common_lights, lights_report, summary_report, world_lights
from pimper_torch.export.result_folder.folders import prepare_output
from pimper_torch.export.result_folder.marker import MARKER
from pimper_torch.export.results import RESULT_NAMES, write_result
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.projection import rays_through
from pimper_torch.io.assets.mesh_files import MeshFiles
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.meshes import read_mesh
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.radiometry.base_color import albedo_scale
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import OutputError
from pimper_torch.runtime.events import Progress
from pimper_torch.runtime.stream import collected
from pimper_torch.stages.meshing.finish import written_channels
from pimper_torch.viz.report.vertex_layers import surface_layers


@dataclass(frozen=True)
class Config:
    zeta: float = 0.5


pytestmark = pytest.mark.usefixtures("small_pictures")


OBJ = {"mesh.obj", "asset.obj", "asset.mtl", "asset_albedo.png", "asset_normal.png"}
ASKED_FOR = {"masks", "mesh.stl", "asset.usdz", *OBJ}  # optional files, not requested here


def names(folder: Path):
    return sorted(path.name for path in folder.iterdir())


def test_a_result_has_exactly_the_listed_files(reconstruction, tmp_path):
    with collected(Progress) as events:
        write_result(reconstruction, Config(), tmp_path / "deep" / "out", about={"preset": "paper"})
    heard = [event.done / event.total for event in events]
    assert heard == sorted(heard)  # one progress bar, filled once
    assert 0 < heard[0] < heard[-1] == 1
    out = tmp_path / "deep" / "out"
    assert names(out) == sorted({*RESULT_NAMES, MARKER} - ASKED_FOR)
    assert names(tmp_path / "deep") == ["out"]
    assert yaml.safe_load((out / "config.yaml").read_text()) == {"zeta": 0.5}
    summary = json.loads((out / "summary.json").read_text())
    assert summary["preset"] == "paper"
    assert summary["unregistered"] == ["d.png"]
    assert (summary["views"], summary["registered"]) == (4, 3)
    assert summary["diagnosis"] is None
    lights = json.loads((out / "lights.json").read_text())
    assert [view["name"] for view in lights["views"]] == ["a.png", "b.png", "c.png"]


def test_the_depth_map_agrees_with_the_surface_and_has_its_error(reconstruction, tmp_path):
    estimated = reconstruction.mesh.replace(expected_error=reconstruction.mesh.vertices_world[:, 2])
    found = {}
    for name, mesh in (("plain", reconstruction.mesh), ("estimated", estimated)):
        write_result(reconstruction.replace(mesh=mesh), Config(), tmp_path / name)
        with np.load(tmp_path / name / "depth.npz", allow_pickle=False) as stored:
            assert str(stored["name"]) == "b.png"
            assert ("expected_error" in stored.files) == (name == "estimated")
            found |= {key: torch.from_numpy(stored[key]) for key in stored.files if key != "name"}
    assert_close(found["cam_from_world"], reconstruction.cameras.cam_from_world[1])
    rows, columns = torch.nonzero(found["mask"], as_tuple=True)
    pixels = torch.stack([columns, rows], dim=-1) + 0.5
    rays = rays_through(pixels, found["cam_from_world"], found["intrinsics"])
    points = reconstruction.cameras.centers_world[1] + found["depth"][rows, columns, None] * rays
    x, y, z = points.unbind(dim=-1)
    # The mesh's chords deviate from the bump by up to its curvature over a cell.
    assert (z - 0.5 * torch.exp(-3 * (x**2 + y**2))).abs().max() < 0.02
    assert len(rows) > 500
    assert found["depth"][~found["mask"]].isnan().all()
    assert 0.45 < found["expected_error"].max() <= 0.5  # at the bump, interpolated
    assert (found["expected_error"][~found["mask"]] == 0).all()


def test_normals_and_albedo_are_images_of_the_reference_view(reconstruction, tmp_path):
    write_result(reconstruction, Config(), tmp_path / "out")
    for name in ("normals.png", "albedo.png"):
        with Image.open(tmp_path / "out" / name) as picture:
            assert (picture.size, picture.mode) == ((60, 40), "RGB")
    colors = np.asarray(Image.open(tmp_path / "out" / "normals.png")).astype(float)
    assert (colors[0, 0] == 0).all()
    centre = colors[20, 30]  # the top of the bump, viewed frontally
    assert centre[2] > 240
    assert abs(centre[:2] - 127.5).max() < 40
    left, right, up, down = colors[20, 25], colors[20, 35], colors[15, 30], colors[25, 30]
    assert left[0] < 110 < 145 < right[0]
    assert down[1] < 110 < 145 < up[1]


def test_world_lights_give_the_same_shading_as_patch_lights(reconstruction):
    facets, lights_world, determined = world_lights(reconstruction)
    assert facets.tolist() == [0, 1]
    assert determined.tolist() == [False, True]  # in the order of the facets
    templates = reconstruction.patches.patches.buckets[0]
    lights_patch = reconstruction.patches.photometric.buckets[0].lights_patch
    normal_world = torch.tensor([[0.6, 0.0, 0.8]])
    turning = templates.patch_from_world[:, :3, :3]
    normals_patch = (turning @ normal_world.T)[..., 0]
    wanted = lights_patch[..., 0] + (lights_patch[..., 1:] * normals_patch[:, None]).sum(dim=-1)
    found = lights_world[..., 0] + lights_world[..., 1:] @ normal_world[0]
    assert_close(found.flip(0), wanted)  # facet 1 is first in the bucket


def test_the_mean_light_excludes_unknown_lights(reconstruction):
    report = lights_report(reconstruction)
    _, lights_world, _ = world_lights(reconstruction)
    # Facet 0 is not determined; view c does not have facet 1.
    assert [view["patches"] for view in report["views"]] == [1, 1, 0]
    mean = torch.tensor(report["views"][0]["light"])
    assert_close(mean, lights_world[1, 0], rtol=1e-5, atol=1e-6)  # lights are about 1
    assert report["views"][2]["light"] is None
    assert report["patches"][1]["lights"][2] is None
    assert report["patches"][0]["lights"][2] is not None
    assert report["reference"] == "b.png"


def test_the_common_light_combines_the_observed_parts_of_all_patches(reconstruction):
    # Each patch's light is the true one plus a component orthogonal to its normals.
    photometric = reconstruction.patches.photometric
    truth = torch.tensor([[0.2, 0.3, -0.5, 0.7], [0.1, -0.4, 0.2, 0.9], [0.3, 0.0, 0.6, 0.5]])
    buckets = []
    for templates, found in zip(photometric.patches.buckets, photometric.buckets, strict=True):
        normals = torch.zeros_like(found.normals_patch)
        normals[..., 0] = torch.linspace(-0.6, 0.6, normals.shape[2])
        normals[..., 2] = -(1 - normals[..., 0].square()).sqrt()  # a cylinder: y is unobserved
        turning = templates.patch_from_world[:, None, :3, :3]
        directed = (turning @ truth[None, :, 1:, None])[..., 0]
        lights = torch.cat([truth[None, :, :1].expand_as(directed[..., :1]), directed], dim=-1)
        lights[..., 2] += 5.0
        found = found.replace(normals_patch=normals, lights_patch=lights)
        buckets.append(found.replace(valid=found.valid | True, status=0 * found.status))
    photometric = photometric.replace(buckets=tuple(buckets))
    rotated = reconstruction.replace(
        patches=reconstruction.patches.replace(photometric=photometric)
    )
    found, counts = common_lights(rotated)
    assert counts.tolist() == [2, 2, 2]
    assert_close(found, truth, rtol=1e-4, atol=1e-5)


def test_the_summary_counts(reconstruction):
    summary = summary_report(reconstruction, {})
    doubted = reconstruction.replace(scene=reconstruction.scene.replace(diagnosis="All is flat."))
    assert summary_report(doubted, {})["diagnosis"] == "All is flat."
    wanted = {
        "mesh_points": 4,
        "triangles": 2,
        "samples": 96,
        "missing_fraction": 0.25,
        "undetermined_fraction": 0.5,
        "vertices": 225,
        "seconds": 2.0,
        "peak_memory_mb": 310.0,
        "peak_memory_stage": "extract",
        "convergence": {"patches": 2, "converged": 1, "mean_iterations": 26.0},
    }
    assert {key: summary[key] for key in wanted} == wanted
    assert [stage["name"] for stage in summary["stages"]] == ["warp", "extract"]
    assert summary["stages"][0]["samples"] == 96


def test_numbers_without_json_form_become_null(reconstruction):
    report = reconstruction.report[0].replace(figures={"mean_residual": float("nan")})
    summary = summary_report(reconstruction.replace(report=(report,)), {})
    assert (summary["missing_fraction"], summary["stages"][0]["mean_residual"]) == (None, None)


def test_a_failure_while_writing_keeps_the_former_result(reconstruction, tmp_path, monkeypatch):
    out = tmp_path / "out"
    write_result(reconstruction, Config(zeta=1.0), out)
    with pytest.raises(OutputError, match=r"already contains albedo\.png"):
        write_result(reconstruction, Config(zeta=2.0), out)

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(results, "write_model", fail)
    with pytest.raises(OutputError, match="No space left"):
        write_result(reconstruction, Config(zeta=2.0), out, overwrite=True)
    assert names(tmp_path) == ["out"]
    assert "1.0" in (out / "config.yaml").read_text()


def test_the_report_is_optional(reconstruction, tmp_path):
    write_result(reconstruction, Config(), tmp_path / "out", report=False)
    assert names(tmp_path / "out") == sorted({*RESULT_NAMES, MARKER} - ASKED_FOR - {"report.html"})


def test_the_page_shows_the_surface_and_its_layers(reconstruction, tmp_path):
    error = torch.linspace(0.001, 0.002, len(reconstruction.mesh.vertices_world))
    mesh = reconstruction.mesh.replace(expected_error=error)
    about = {"warnings": ["Two photographs are blurred."]}
    write_result(reconstruction.replace(mesh=mesh), Config(), tmp_path / "cup", about=about)
    page = (tmp_path / "cup" / "report.html").read_text()
    data = json.loads(re.search(r'id="data">(.*?)</script>', page)[1])
    assert data["title"] == "cup"
    assert [layer["title"] for layer in data["layers"]] == ["expected error", "support"]
    assert data["layers"][0]["high"] == pytest.approx(0.002, rel=0.1)
    assert len(data["views"]) == 3
    assert all("prediction" in view and "light" in view for view in data["views"])
    # `pimper view` reads the file and shows the same colours.
    layer, _ = surface_layers(read_mesh(tmp_path / "cup" / "mesh.ply"))
    assert data["layers"][0]["high"] == layer.high
    lights = json.loads((tmp_path / "cup" / "lights.json").read_text())["views"]
    assert [view.get("environment") for view in data["views"]] == [one["light"] for one in lights]
    assert data["summary"]["warnings"] == ["Two photographs are blurred."]
    assert "zeta" in data["settings"]
    asset = base64.b64decode(re.search(r'id="asset">(.*?)</script>', page)[1])
    assert asset == (tmp_path / "cup" / "asset.glb").read_bytes()


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("file", "file: is a file"),
        ("file/out", "out: cannot be written"),
        ("new", "cannot be written, as .* not a writable folder"),
    ],
)
def test_a_folder_that_cannot_be_written_is_refused_beforehand(tmp_path, monkeypatch, name, why):
    (tmp_path / "file").write_text("")
    if name == "new":
        monkeypatch.setattr(os, "access", lambda *_: False)  # root can write to any folder
    with pytest.raises(OutputError, match=why):
        prepare_output(tmp_path / name, "result")


def test_the_written_mesh_is_simplified_and_the_summary_has_its_deviation(reconstruction, tmp_path):
    vertices, faces = icosphere(4)
    ball = Mesh(
        vertices_world=vertices.float(),
        faces=faces,
        albedo=0.5 + 0.4 * vertices[:, :1].float(),
        confidence=torch.ones(len(vertices)),
        expected_error=torch.full((len(vertices),), 0.01),
    )
    result = reconstruction.replace(mesh=ball)
    write_result(result, Config(), tmp_path / "few")
    write_result(result, Config(), tmp_path / "all", files=MeshFiles(faces="all"))
    summaries = [
        json.loads((tmp_path / name / "summary.json").read_text()) for name in ("few", "all")
    ]
    assert [summary["vertices"] for summary in summaries] == [len(vertices)] * 2
    assert "simplified" not in summaries[1]
    figures = summaries[0]["simplified"]
    few, whole = (read_mesh(tmp_path / name / "mesh.ply") for name in ("few", "all"))
    assert len(few.vertices_world) == figures["vertices"] < len(vertices)
    assert len(few.faces) == figures["faces"]
    assert 0 < figures["max_spacings"] <= 0.1
    assert 0 < figures["max_angle_deg"] <= 2.0
    distance = NearestSurface(few).query(whole.vertices_world).distance
    assert distance.max() <= 0.1 * figures["spacing"] * 1.001
    assert len(whole.vertices_world) == len(vertices)
    glb = [read_mesh(tmp_path / name / "mesh.glb").faces for name in ("few", "all")]
    assert [len(one) for one in glb] == [len(few.faces), len(faces)]


def test_channels_are_scaled_by_their_tolerances(reconstruction):
    mesh = reconstruction.mesh.replace(expected_error=torch.full((225,), 0.02))
    channels = written_channels(mesh)
    more = mesh.replace(confidence=mesh.confidence + 0.1, expected_error=torch.full((225,), 0.0221))
    assert_close(written_channels(more)[:, 3] - channels[:, 3], torch.ones(225))
    assert (written_channels(more)[:, 4] - channels[:, 4] > 0.99).all()
    encoded = 255 * srgb_from_linear((mesh.albedo * albedo_scale(mesh)).clamp(0, 1))
    assert_close(8 * channels[:, :3], encoded)
    bare = mesh.replace(albedo=None, confidence=None, expected_error=None)
    assert written_channels(bare).shape == (225, 0)


def test_a_far_result_is_written_in_the_frame_of_its_cameras(reconstruction, tmp_path):
    offset = (448231.0, 5411923.0, 312.0)
    shift = torch.tensor(offset, dtype=torch.float64)
    far = reconstruction.replace(scene=reconstruction.scene.replace(offset_world=offset))
    for name, result in (("near", reconstruction), ("far", far)):
        write_result(result, Config(), tmp_path / name, files=MeshFiles(faces="all"))
    near, placed = read_estimate(tmp_path / "near"), read_estimate(tmp_path / "far")
    vertices = near.mesh.vertices_world
    assert_close(placed.mesh.vertices_world, vertices + shift, rtol=0, atol=2e-7)
    glb = read_mesh(tmp_path / "far" / "mesh.glb")
    assert_close(glb.vertices_world, placed.mesh.vertices_world, rtol=0, atol=2e-7)
    centers = near.cameras.centers_world + shift
    assert_close(placed.cameras.centers_world, centers, rtol=0, atol=2e-6)
    cloud = read_model(tmp_path / "far" / "sparse").points_world
    assert_close(cloud, reconstruction.scene.points_world.double() + shift, rtol=0, atol=1e-8)
    summary = json.loads((tmp_path / "far" / "summary.json").read_text())
    assert summary["offset_world"] == list(offset)
    arrays = [np.load(tmp_path / name / "depth.npz") for name in ("near", "far")]
    assert arrays[1]["cam_from_world"].dtype == np.float64
    assert arrays[0]["cam_from_world"].dtype == np.float32
    index = placed.names.index(str(arrays[1]["name"]))
    pose = placed.cameras.cam_from_world[index].numpy()
    np.testing.assert_allclose(arrays[1]["cam_from_world"], pose, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(arrays[0]["depth"], arrays[1]["depth"])
    # The run's own records are in the same frame.
    own = estimate_of(far)
    assert_close(own.mesh.vertices_world, placed.mesh.vertices_world, rtol=0, atol=2e-7)
    assert_close(own.cameras.centers_world, placed.cameras.centers_world, rtol=0, atol=1e-7)
