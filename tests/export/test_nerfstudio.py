import json
import warnings

import cv2
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from pimper_bench.datasets import read_transforms
from pimper_torch.export.nerfstudio import depth_unit, point_subset, write_nerfstudio
from pimper_torch.geometry.rigid import rigid
from pimper_torch.io.meshes import read_mesh
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.viz.maps import view_maps


def test_an_export_survives_a_round_trip(result, tmp_path, same_cameras):
    write_nerfstudio(result, tmp_path)
    found = read_transforms(tmp_path)
    same_cameras(found.cameras, result.cameras)
    assert found.views.names == result.scene.views.names
    assert torch.equal(found.views.masks, result.silhouettes.masks)


def test_splats_are_initialized_on_the_surface_with_its_colours(result, tmp_path):
    write_nerfstudio(result, tmp_path)
    name = json.loads((tmp_path / "transforms.json").read_text())["ply_file_path"]
    found = read_mesh(tmp_path / name)
    assert_close(found.vertices_world, result.mesh.vertices_world.double())
    assert_close(found.albedo.float(), result.mesh.albedo, rtol=0, atol=0.02)


def test_points_are_thinned_evenly_to_a_hundred_thousand():
    assert point_subset(0).tolist() == []
    assert point_subset(5).tolist() == [0, 1, 2, 3, 4]
    many = point_subset(1_000_000)
    assert (len(many), int(many[0]), int(many[-1])) == (100_000, 0, 999_999)
    assert set(many.diff().tolist()) == {10, 11} or set(many.diff().tolist()) == {10}


def depths_of(folder):
    """Read every frame's depth as nerfstudio does (``get_depth_image_from_path``)."""
    whole = json.loads((folder / "transforms.json").read_text())
    unit = whole["depth_unit_scale_factor"]
    files = [folder / frame["depth_file_path"] for frame in whole["frames"]]
    levels = [cv2.imread(str(file), cv2.IMREAD_ANYDEPTH) for file in files]
    assert all(one.dtype == np.uint16 for one in levels)
    return unit, [one.astype(np.float64) * unit for one in levels]


def test_depths_are_read_back_to_half_a_millimetre_of_the_default_unit(result, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_nerfstudio(result, tmp_path)
    unit, depths = depths_of(tmp_path)
    assert unit == 0.001
    for view, depth in enumerate(depths):
        maps = view_maps(result.mesh, result.mesh_cameras, view)
        assert np.array_equal(depth == 0, ~maps.seen.numpy())
        assert np.abs(depth - maps.depth.nan_to_num(0).numpy()).max() < 0.00051


def test_depths_beyond_sixteen_bits_have_a_different_unit_and_its_option(result, tmp_path):
    size = 100.0
    poses = result.cameras.cam_from_world
    cameras = result.cameras.replace(cam_from_world=rigid(poses[:, :3, :3], size * poses[:, :3, 3]))
    mesh = result.mesh.replace(vertices_world=size * result.mesh.vertices_world)
    with pytest.warns(PimperWarning, match=r"nerfstudio-data --depth-unit-scale-factor 0\.01"):
        write_nerfstudio(result.replace(mesh=mesh, cameras=cameras), tmp_path)
    unit, depths = depths_of(tmp_path)
    assert unit == 0.01
    expected = size * view_maps(result.mesh, result.mesh_cameras, 0).depth.nan_to_num(0).numpy()
    assert np.abs(depths[0] - expected).max() < 0.0051


@pytest.mark.parametrize("farthest", [1e-4, 0.3, 0.999, 1.0, 6.4, 65.5, 65.6, 700.0, 1e7])
def test_a_unit_of_depth_is_exact_to_a_thousandth_and_fits_sixteen_bits(farthest):
    assert farthest / depth_unit(farthest) * (1 + 1e-12) >= 1000
    assert farthest / depth_unit(farthest) <= 65535
    if 1 <= farthest <= 65.5:
        assert depth_unit(farthest) == 0.001
