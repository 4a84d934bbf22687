import json

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_bench.datasets import read_transforms
from pimper_bench.metrics.estimates import estimate_of
from pimper_torch.chains.chain_config import CoarseToFineConfig
from pimper_torch.export import read_result, read_written, results, write_formats
from pimper_torch.export.nerfstudio import write_nerfstudio
from pimper_torch.geometry.projection import project
from pimper_torch.io.assets.mesh_files import MeshFiles
from pimper_torch.io.meshes import read_mesh
from pimper_torch.radiometry import Encoding
from pimper_torch.runtime.errors import InputError, PimperWarning


def test_a_result_folder_is_read_back_as_in_the_run(folder, run):
    found = read_result(folder)
    scene = run.scene
    assert found.scene.views.names == scene.views.names == ("a.png", "b.png", "c.png")
    assert torch.equal(found.scene.views.images, scene.views.images)
    assert (found.cameras.intrinsics[:, 0, 0] > 91).all()  # the lens was undistorted
    assert_close(found.scene.cameras.intrinsics, scene.cameras.intrinsics)
    assert_close(found.scene.cameras.cam_from_world, scene.cameras.cam_from_world)
    assert_close(found.cameras.intrinsics.float(), scene.cameras.intrinsics)
    assert found.scene.lenses == scene.lenses
    assert found.scene.unregistered == scene.unregistered == ("d.png",)
    assert_close(found.scene.points_world, scene.points_world)
    order = torch.argsort(scene.observation_point, stable=True)
    assert_close(found.scene.observation_pixels, scene.observation_pixels[order])
    assert torch.equal(found.silhouettes.inside, run.silhouettes.inside)
    assert torch.equal(found.silhouettes.reliable, run.silhouettes.reliable)
    assert found.silhouettes.source == "found"
    assert found.reference == "b.png"
    assert found.summary["registered"] == 3
    assert f"{len(found.mesh.faces):,}" in found._repr_html_()
    assert found.plot().height == 360
    assert found.summary["verdict"]["score"] == min(found.summary["verdict"]["scores"].values())
    assert found.mesh.vertices_world.dtype == torch.float32
    lights = estimate_of(run).lights_world.double()
    assert_close(found.lights_world, lights, rtol=1e-5, atol=1e-6, equal_nan=True)


def test_moved_photographs_are_named(folder, photographs, tmp_path):
    there = read_result(folder)
    moved = photographs.rename(tmp_path / "moved")
    with pytest.raises(
        InputError, match=rf"a\.png, b\.png, c\.png are not in {photographs}.*--photos"
    ):
        read_result(folder)
    found = read_result(folder, moved)
    assert torch.equal(found.scene.views.images, there.scene.views.images)


def test_converted_photographs_keep_their_names_and_give_a_warning(folder, photographs):
    there = read_result(folder)
    with Image.open(photographs / "a.png") as picture:
        picture.save(photographs / "a.tif")
    (photographs / "a.png").unlink()
    with pytest.warns(PimperWarning, match=r"were converted since .*; a\.tif for a\.png are read"):
        found = read_result(folder)
    assert found.scene.views.names == there.scene.views.names
    assert torch.equal(found.scene.views.images, there.scene.views.images)


def test_a_result_is_the_same_with_and_without_photographs(folder, photographs, tmp_path):
    there = read_result(folder)
    photographs.rename(tmp_path / "moved")
    found = read_written(folder)
    assert torch.equal(found.mesh.vertices_world, there.mesh.vertices_world)
    assert torch.equal(found.mesh_cameras.intrinsics, there.scene.cameras.intrinsics)
    assert torch.equal(found.mesh_cameras.cam_from_world, there.scene.cameras.cam_from_world)
    assert torch.equal(found.mesh_cameras.sizes_px, there.scene.cameras.sizes_px)
    assert found.offset_world == there.scene.offset_world
    with pytest.raises(InputError, match="colmap contains photographs"):
        write_formats(found, ["colmap"], tmp_path / "more")


def grey(path):
    Image.fromarray(np.full((40, 50), 99, np.uint8)).save(path)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda out, photos: grey(photos / "b.png"), r"b\.png: has 50 x 40 .* but 60 x 40"),
        (lambda out, photos: (photos / "b.png").unlink(), r"photographs b\.png are not in"),
        (lambda out, photos: grey(out / "masks" / "c.png"), r"c\.png: has 50 x 40 .*: 60 x 40"),
        (lambda out, photos: (out / "config.yaml").unlink(), r"lacks config\.yaml"),
        (lambda out, photos: out.rename(out.parent / "away"), "is not a folder"),
    ],
)
def test_a_damaged_or_mismatching_result_is_refused(folder, photographs, change, why):
    change(folder, photographs)
    with pytest.raises(InputError, match=why):
        read_result(folder)


def test_a_result_without_silhouettes_counts_everything_as_object(folder):
    for path in (folder / "masks").iterdir():
        path.unlink()
    (folder / "masks").rmdir()
    found = read_result(folder).silhouettes
    assert found.source == "everything"
    assert found.masks.all()


def test_a_summary_without_photographs_asks_for_them(folder, photographs):
    summary = json.loads((folder / "summary.json").read_text())
    del summary["photographs"]
    (folder / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(InputError, match="does not name the folder of its photographs"):
        read_result(folder)
    assert read_result(folder, photographs).scene.views.num_views == 3


def test_larger_photographs_are_shrunk_to_those_of_the_run(folder, photographs):
    there = read_result(folder)
    for path in photographs.iterdir():
        with Image.open(path) as picture:
            picture.resize((120, 80), Image.Resampling.NEAREST).save(path)
    found = read_result(folder)
    assert torch.equal(found.scene.views.sizes_px, there.scene.views.sizes_px)
    assert torch.equal(found.cameras.intrinsics, there.cameras.intrinsics)


@pytest.mark.usefixtures("without_pictures")
def test_a_result_far_from_the_origin_is_read_near_it(run, photographs, tmp_path):
    far = (500_000.0, -3.0, 0.0)
    scene = run.scene.replace(offset_world=far)
    about = {"photographs": str(photographs)}
    config = CoarseToFineConfig(photographs=Encoding(response="linear"))
    every = MeshFiles(faces="all")
    moved = run.replace(scene=scene)
    results.write_result(moved, config, tmp_path / "far", about=about, files=every)
    found = read_result(tmp_path / "far")
    assert abs(found.scene.offset_world[0] - far[0]) < 10
    seen = [
        project(
            one.mesh.vertices_world, one.scene.cameras.cam_from_world, one.scene.cameras.intrinsics
        )[0]
        for one in (run, found)
    ]
    assert_close(*seen, rtol=0, atol=1e-3)
    centers = run.scene.cameras.centers_world.double() + torch.tensor(far)
    assert_close(found.cameras.centers_world, centers, rtol=0, atol=1e-5)
    write_nerfstudio(found, tmp_path / "splats")
    splats = read_transforms(tmp_path / "splats").cameras
    assert_close(splats.centers_world, centers, rtol=0, atol=1e-5)
    placed = found.mesh.vertices_world.double() + torch.tensor(found.scene.offset_world)
    assert_close(read_mesh(tmp_path / "splats" / "sparse_pc.ply").vertices_world, placed)
