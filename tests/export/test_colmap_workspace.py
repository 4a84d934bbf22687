import numpy as np
import pycolmap
import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.datasets import read_colmap
from pimper_torch.export.colmap_workspace import write_workspace
from pimper_torch.geometry.projection import project
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.meshes import read_mesh
from pimper_torch.viz.maps import view_maps

FILES = ("a.png", "b.png", "c.png")


@pytest.fixture
def workspace(result, tmp_path):
    write_workspace(result, tmp_path / "dense")
    return tmp_path / "dense"


def test_photographs_masks_and_cameras_are_read_back(workspace, result, same_cameras):
    found = read_colmap(workspace)
    same_cameras(found.cameras, result.cameras)
    assert found.views.names == FILES
    assert torch.equal(found.views.masks, result.silhouettes.masks)
    half_a_level = 0.5 / 255 * 2.3  # the maximum slope of sRGB
    assert_close(found.views.images, result.scene.views.images, rtol=0, atol=half_a_level)


def test_tracks_are_projections_of_their_points(workspace, result):
    model = read_model(workspace / "sparse")
    seen, _ = project(model.points_world, result.cameras.cam_from_world, result.cameras.intrinsics)
    expected = seen[model.observation_view, model.observation_point]
    assert len(expected) == len(result.scene.observation_view)
    assert_close(model.observation_pixels, expected, rtol=0, atol=1e-3)  # the scene is float32


def test_colmap_reads_the_written_depths_and_normals(workspace, result):
    for view, file in enumerate(FILES):
        maps = view_maps(result.mesh, result.scene.cameras, view)
        assert maps.seen.any()
        assert not maps.seen.all()  # or the value 0 for no data is not tested
        depth, normals = pycolmap.DepthMap(), pycolmap.NormalMap()
        depth.read(workspace / "stereo" / "depth_maps" / f"{file}.geometric.bin")
        normals.read(workspace / "stereo" / "normal_maps" / f"{file}.geometric.bin")
        assert np.array_equal(depth.to_array(), maps.depth.nan_to_num(0).numpy())
        # pycolmap returns COLMAP's three planes as if they were interleaved.
        planes = normals.to_array().reshape(3, 40, 60)
        assert np.array_equal(planes, maps.normals_cam.movedim(-1, 0).numpy())


def test_colmap_fuses_the_maps_to_points_on_the_surface(workspace, tmp_path):
    model = pycolmap.MVSModel()
    model.read(workspace, "COLMAP")
    assert [model.get_image_name(index) for index in range(3)] == list(FILES)
    options = pycolmap.StereoFusionOptions()
    # Three views with pixels a tenth as wide as the bump.
    options.min_num_pixels, options.num_threads, options.max_normal_error = 2, 1, 30
    options.max_reproj_error = 1.0
    pycolmap.stereo_fusion(tmp_path / "f.ply", workspace, options=options, output_type="PLY")
    fused = read_mesh(tmp_path / "f.ply")
    x, y, z = fused.vertices_world.unbind(dim=1)
    assert len(z) > 300
    height = 0.5 * torch.exp(-3 * (x**2 + y**2))
    # A fused point is the median of pixels up to one apart, 6/90, on slopes up to 0.75.
    assert float((z - height).abs().max()) < 0.75 * 6 / 90
    assert float((z - height).abs().median()) < 0.01  # facets of 1/7, curvature 3
    slopes = torch.stack([6 * x * height, 6 * y * height, torch.ones_like(x)], dim=1)
    agreement = (normalize(slopes, dim=1) * fused.normals_world).sum(dim=1)
    assert float(agreement.min()) > 0.95
