import sys

import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_torch.errors import ConfigError, MissingProgramError, ReconstructionError
from pimper_torch.evidence.baselines.colmap_dense import ColmapDense, ColmapDenseConfig, trim_depth
from pimper_torch.io.meshes import write_ply
from pimper_torch.records import Mesh
from pimper_torch.sfm.colmap import read_model

# Checks what every command needs from the ones before, and leaves what COLMAP leaves.
FAKE = """#!{python}
import pathlib, shutil, sys
command, *arguments = sys.argv[1:]
options = dict(zip(arguments[::2], arguments[1::2]))
own = {{
    "patch_match_stereo": "PatchMatchStereo",
    "stereo_fusion": "StereoFusion",
    "poisson_mesher": "PoissonMeshing",
    "delaunay_mesher": "DelaunayMeshing",
}}[command]
plain = {{"--workspace_path", "--workspace_format", "--input_type", "--input_path"}}
plain.add("--output_path")
assert all(name in plain or name.startswith("--" + own + ".") for name in options), options
print(command, options)
if command == "patch_match_stereo":
    {match}
    here = pathlib.Path(options["--workspace_path"])
    shutil.copytree(here, {copy!r}, dirs_exist_ok=True)
    (here / "stereo/depth_maps/00000000.png.geometric.bin").touch()
if command == "stereo_fusion":
    here = pathlib.Path(options["--workspace_path"])
    assert list((here / "stereo/depth_maps").iterdir())
    masks = options.get("--StereoFusion.mask_path")
    assert (masks is not None) == (here / "masks").exists()
    shutil.copy({cloud!r}, options["--output_path"])
if command == "poisson_mesher":
    assert pathlib.Path(options["--input_path"]).name == "fused.ply"
    assert pathlib.Path(options["--input_path"]).is_file()
    shutil.copy({mesh!r}, options["--output_path"])
if command == "delaunay_mesher":
    assert (pathlib.Path(options["--input_path"]) / "fused.ply").is_file()
    assert options["--input_type"] == "dense"
    shutil.copy({mesh!r}, options["--output_path"])
"""
CLOUD = b"""ply
format ascii 1.0
element vertex 1
property float x
property float y
property float z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
end_header
0.5 -0.25 1.5 0 0.6 0.8 200 100 50
"""


@pytest.fixture(autouse=True)
def _no_colmap(monkeypatch, tmp_path):
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("PIMPER_COLMAP", raising=False)


@pytest.fixture
def triangle():
    corners = torch.tensor([[0.5, 0, 1], [0, 0.25, 1], [0, 0, 1.5]])
    return Mesh(vertices_world=corners, faces=torch.tensor([[0, 1, 2]]), albedo=corners / 2)


def install(tmp_path, triangle, match="pass"):
    write_ply(triangle, tmp_path / "mesh.ply")
    (tmp_path / "cloud.ply").write_bytes(CLOUD)
    path = tmp_path / "bin" / "colmap"
    path.write_text(
        FAKE.format(
            python=sys.executable,
            copy=str(tmp_path / "seen"),
            mesh=str(tmp_path / "mesh.ply"),
            cloud=str(tmp_path / "cloud.ply"),
            match=match,
        )
    )
    path.chmod(0o755)
    return tmp_path / "seen"


@pytest.mark.parametrize("mesher", ["poisson", "delaunay"])
def test_the_mesh_comes_back_in_the_scenes_frame(reconstruction, triangle, tmp_path, mesher):
    install(tmp_path, triangle)
    dense = ColmapDense(ColmapDenseConfig(mesher=mesher))
    estimate = dense(reconstruction.scene, reconstruction.coarse)
    assert_close(estimate.mesh.vertices_world, triangle.vertices_world)
    assert torch.equal(estimate.mesh.faces, triangle.faces)
    assert estimate.mesh.albedo is None  # its colours are radiance
    assert estimate.cameras is reconstruction.scene.cameras
    assert estimate.reference == "b.png"


def test_without_a_mesher_the_fused_points_come_back(reconstruction, triangle, tmp_path):
    install(tmp_path, triangle)
    dense = ColmapDense(ColmapDenseConfig(mesher="none"))
    mesh = dense(reconstruction.scene, reconstruction.coarse).mesh
    assert_close(mesh.vertices_world, torch.tensor([[0.5, -0.25, 1.5]]))
    assert_close(mesh.normals_world, torch.tensor([[0, 0.6, 0.8]]))
    assert mesh.faces.shape == (0, 3)


def test_the_workspace_is_laid_out_as_colmaps_own_undistorter_does(
    reconstruction, triangle, tmp_path
):
    copy = install(tmp_path, triangle)
    masks = torch.zeros(3, 40, 60, dtype=torch.bool)
    masks[2, 3, 4] = True
    scene = reconstruction.scene
    scene = scene.replace(views=scene.views.replace(masks=masks))
    ColmapDense()(scene, reconstruction.coarse)
    names = [f"{index:08d}.png" for index in range(3)]
    assert sorted(path.name for path in (copy / "images").iterdir()) == names
    pairs = (copy / "stereo" / "patch-match.cfg").read_text().splitlines()
    assert pairs == [line for name in names for line in (name, "__auto__, 20")]
    assert (copy / "stereo" / "fusion.cfg").read_text().splitlines() == names
    for folder in ("depth_maps", "normal_maps", "consistency_graphs"):
        assert (copy / "stereo" / folder).is_dir()
    assert read_model(copy / "sparse").names == tuple(names)
    with Image.open(copy / "masks" / "00000002.png.png") as mask:
        assert mask.getpixel((4, 3)) == 255
        assert mask.getpixel((3, 4)) == 0


def test_settings_reach_the_commands(reconstruction, triangle, tmp_path):
    install(tmp_path, triangle)
    config = ColmapDenseConfig(max_size_px=777, gpu="1", threads=5, keep_in=tmp_path / "kept")
    ColmapDense(config)(reconstruction.scene, reconstruction.coarse)
    (kept,) = (tmp_path / "kept").iterdir()
    printed = "".join(path.read_text() for path in kept.glob("colmap-*.log"))
    assert "'--PatchMatchStereo.max_image_size': '777'" in printed
    assert "'--StereoFusion.max_image_size': '777'" in printed
    assert "'--PatchMatchStereo.gpu_index': '1'" in printed
    assert "'--PoissonMeshing.num_threads': '5'" in printed


def test_poissons_surface_is_trimmed_by_the_density_of_the_cloud(
    reconstruction, triangle, tmp_path
):
    # COLMAP's 10 trims the whole surface away from a cloud of some thousand points.
    assert trim_depth(10_000_000) == pytest.approx(10)
    assert trim_depth(4 * 5000) == pytest.approx(trim_depth(5000) + 1)
    assert trim_depth(0) == 0
    install(tmp_path, triangle)
    for trim, wanted in ((None, "0.00"), (7.0, "7.00")):  # one point; as set
        config = ColmapDenseConfig(poisson_trim=trim, keep_in=tmp_path / wanted)
        ColmapDense(config)(reconstruction.scene, reconstruction.coarse)
        printed = "".join(path.read_text() for path in (tmp_path / wanted).rglob("colmap-*.log"))
        assert f"'--PoissonMeshing.trim': '{wanted}'" in printed


def test_a_colmap_without_cuda_is_told_from_one_that_found_nothing(
    reconstruction, triangle, tmp_path
):
    # In the words of COLMAP 3.8 and of its present version.
    for words in (
        "ERROR: Dense stereo reconstruction requires CUDA, which is not available on your system.",
        "mvs.cc:179] Dense stereo reconstruction requires CUDA, which is not available",
    ):
        install(tmp_path, triangle, match=f"sys.exit({words!r})")
        with pytest.raises(ReconstructionError, match=r"needs a build with CUDA.*NVIDIA"):
            ColmapDense()(reconstruction.scene, reconstruction.coarse)
    install(tmp_path, triangle, match="sys.exit('no images')")
    with pytest.raises(ReconstructionError, match="patch_match_stereo") as caught:
        ColmapDense()(reconstruction.scene, reconstruction.coarse)
    assert "NVIDIA" not in str(caught.value)
    assert "no images" in str(caught.value)


def test_a_missing_colmap_and_impossible_settings_are_refused(reconstruction, tmp_path):
    with pytest.raises(MissingProgramError, match="colmap is not installed"):
        ColmapDense()(reconstruction.scene, reconstruction.coarse)
    (tmp_path / "bin" / "colmap").write_bytes(b"\x7fELF of another machine")
    (tmp_path / "bin" / "colmap").chmod(0o755)
    with pytest.raises(MissingProgramError, match="cannot be started"):
        ColmapDense()(reconstruction.scene, reconstruction.coarse)
    for setting in ({"max_size_px": 0}, {"threads": -1}, {"max_minutes": -1.0}):
        with pytest.raises(ConfigError, match=next(iter(setting))):
            ColmapDenseConfig(**setting)
