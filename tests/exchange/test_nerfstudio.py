import json

import torch
from torch.testing import assert_close

from pimper_bench.datasets import read_transforms
from pimper_torch.doors.exchange.nerfstudio import thinned, write_nerfstudio
from pimper_torch.doors.io.meshes import read_mesh


def test_what_is_written_is_read_back(result, tmp_path, same_cameras):
    write_nerfstudio(result, tmp_path)
    found = read_transforms(tmp_path)
    same_cameras(found.cameras, result.cameras)
    assert found.views.names == result.scene.views.names
    assert torch.equal(found.views.masks, result.silhouettes.masks)


def test_splats_start_at_the_surface_in_its_colours(result, tmp_path):
    write_nerfstudio(result, tmp_path)
    name = json.loads((tmp_path / "transforms.json").read_text())["ply_file_path"]
    found = read_mesh(tmp_path / name)
    assert_close(found.vertices_world, result.mesh.vertices_world.double())
    assert_close(found.albedo.float(), result.mesh.albedo, rtol=0, atol=0.02)


def test_points_are_thinned_evenly_to_a_hundred_thousand():
    assert thinned(0).tolist() == []
    assert thinned(5).tolist() == [0, 1, 2, 3, 4]
    many = thinned(1_000_000)
    assert (len(many), int(many[0]), int(many[-1])) == (100_000, 0, 999_999)
    assert set(many.diff().tolist()) == {10, 11} or set(many.diff().tolist()) == {10}
