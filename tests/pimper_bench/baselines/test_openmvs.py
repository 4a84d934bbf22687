import sys

import pytest
import torch
from torch.testing import assert_close

from pimper_bench.baselines.missing import MissingProgramError
from pimper_bench.baselines.openmvs import OpenMvs
from pimper_torch.geometry.lens_models import distort
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import transform
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.meshes import write_ply
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import InputError, ReconstructionError

# Every program refuses unknown options, checks its input, and writes the files of OpenMVS.
FAKE = """#!{python}
import pathlib, shutil, sys
name = pathlib.Path(sys.argv[0]).name
known = {{"-i", "-w", "--max-threads"}} | {{
    "InterfaceCOLMAP": set(),
    "DensifyPointCloud": set(),
    "ReconstructMesh": {{"-p"}},
    "RefineMesh": {{"--mesh-file"}},
}}[name]
options = dict(zip(sys.argv[1::2], sys.argv[2::2]))
assert set(options) <= known, sorted(set(options) - known)
here = pathlib.Path(options["-w"])
given = here / options["-i"]
assert given.exists(), given
if name == "InterfaceCOLMAP":
    shutil.copytree(given, {copy!r})
    (given / "scene.mvs").touch()
if name == "DensifyPointCloud":
    (here / "scene_dense.mvs").touch()
    (here / "scene_dense.ply").touch()
if name == "ReconstructMesh":
    assert (here / options["-p"]).exists()
    if {finds}:
        shutil.copy({mesh!r}, here / "scene_dense_mesh.ply")
if name == "RefineMesh":
    assert (here / options["--mesh-file"]).exists()
    shutil.copy({refined!r}, here / "scene_dense_refine.ply")
"""
PROGRAMS = ("InterfaceCOLMAP", "DensifyPointCloud", "ReconstructMesh", "RefineMesh")


@pytest.fixture
def triangle():
    corners = torch.tensor([[0.5, 0, 1], [0, 0.25, 1], [0, 0, 1.5]])
    return Mesh(vertices_world=corners, faces=torch.tensor([[0, 1, 2]]))


def install(tmp_path, triangle, *, finds=True, names=PROGRAMS):
    write_ply(triangle, tmp_path / "mesh.ply")
    write_ply(
        triangle.replace(vertices_world=triangle.vertices_world + 1), tmp_path / "refined.ply"
    )
    for name in names:
        path = tmp_path / "bin" / name
        path.write_text(
            FAKE.format(
                python=sys.executable,
                copy=str(tmp_path / "seen"),
                mesh=str(tmp_path / "mesh.ply"),
                refined=str(tmp_path / "refined.ply"),
                finds=finds,
            )
        )
        path.chmod(0o755)
    return tmp_path / "seen"


def test_the_mesh_is_in_the_scenes_frame(reconstruction, triangle, tmp_path):
    install(tmp_path, triangle)
    estimate = OpenMvs()(reconstruction.scene, reconstruction.coarse)
    assert_close(estimate.mesh.vertices_world, triangle.vertices_world + 1)
    assert torch.equal(estimate.mesh.faces, triangle.faces)
    assert estimate.names == ("a.png", "b.png", "c.png")
    assert estimate.reference == "b.png"
    assert not list(tmp_path.glob("pimper-*"))


def test_the_written_model_is_the_undistorted_scene(reconstruction, triangle, tmp_path):
    copy = install(tmp_path, triangle)
    scene = reconstruction.scene
    # Separate cameras, a camera model with distortion, an unusual name, a point without
    # observations and a NaN error.
    own = scene.cameras.intrinsics.clone()
    own[:, 0, 0], own[:, 1, 1] = torch.tensor([91.0, 92, 93]), torch.tensor([81.0, 82, 83])
    own[:, 0, 2] = 28.25
    lens = scene.lenses[0].replace(model="SIMPLE_RADIAL", params=(80.0, 30.0, 20.0, 0.1))
    kept = scene.observation_point != 3
    rays = transform(scene.cameras.cam_from_world, scene.points_world)
    photographed = distort(lens, rays[scene.observation_view, scene.observation_point])
    scene = scene.replace(
        cameras=scene.cameras.replace(intrinsics=own),
        lenses=(lens,) * 3,
        views=scene.views.replace(names=("a b.png", "folder/b.png", "ü.png")),
        observation_point=scene.observation_point[kept],
        observation_view=scene.observation_view[kept],
        observation_pixels=photographed[kept],
        reprojection_errors_px=torch.full_like(scene.reprojection_errors_px, torch.inf),
    )
    OpenMvs()(scene, reconstruction.coarse)
    model = read_model(copy / "sparse")
    assert model.names == ("00000000.png", "00000001.png", "00000002.png")
    assert all((copy / "images" / name).is_file() for name in model.names)
    for index, lens in enumerate(model.lenses):
        assert lens.model == "PINHOLE"
        assert lens.params == pytest.approx((91 + index, 81 + index, 28.25, 20))
        assert (lens.width, lens.height) == (60, 40)
    assert_close(model.cam_from_world, scene.cameras.cam_from_world.double(), rtol=0, atol=1e-6)
    seen = torch.arange(len(scene.points_world)) != 3
    assert_close(model.points_world, scene.points_world[seen].double())
    assert len(model.observation_point) == int(kept.sum())
    pixels, _ = project(
        model.points_world, scene.cameras.cam_from_world.double(), scene.cameras.intrinsics.double()
    )
    wanted = pixels[model.observation_view, model.observation_point]
    assert_close(model.observation_pixels, wanted, rtol=0, atol=1e-4)


def test_every_missing_program_is_named_before_the_first_runs(reconstruction, triangle, tmp_path):
    copy = install(tmp_path, triangle, names=PROGRAMS[:2])
    with pytest.raises(MissingProgramError, match="ReconstructMesh is not installed"):
        OpenMvs()(reconstruction.scene, reconstruction.coarse)
    assert not copy.exists()


def test_a_step_without_output_is_named(reconstruction, triangle, tmp_path):
    install(tmp_path, triangle, finds=False)
    with pytest.raises(ReconstructionError, match=r"ReconstructMesh .* did not write scene_dense"):
        OpenMvs()(reconstruction.scene, reconstruction.coarse)
    (tmp_path / "bin" / "DensifyPointCloud").write_text(f"#!{sys.executable}\nprint('too dark')")
    (tmp_path / "seen").rename(tmp_path / "before")
    with pytest.raises(
        ReconstructionError, match=r"(?s)DensifyPointCloud .* did not write.*too dark"
    ):
        OpenMvs()(reconstruction.scene, reconstruction.coarse)


def test_a_scene_without_points_is_refused(reconstruction, triangle, tmp_path):
    install(tmp_path, triangle)
    none = torch.zeros(0, dtype=torch.long)
    scene = reconstruction.scene.replace(
        observation_point=none, observation_view=none, observation_pixels=torch.zeros(0, 2)
    )
    with pytest.raises(InputError, match="no sparse points"):
        OpenMvs()(scene, reconstruction.coarse)
