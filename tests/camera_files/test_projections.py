import pytest
import torch
from torch.testing import assert_close

from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.doors.camera_files.posed_camera import decompose_projections


@pytest.mark.parametrize("factor", [1.0, -1.0, 3e-4, -250.0])
def test_cameras_are_found_from_their_projections_whatever_the_factor(factor):
    cameras = arc_cameras(3, width=64, height=48, focal_px=90.0, distance=700.0)
    K = cameras.intrinsics.clone()
    K[:, 0, 1], K[:, 1, 1] = 0.3, 91.0  # skew and unlike focal lengths survive
    projections = factor * K @ cameras.cam_from_world[:, :3]
    found, pose = decompose_projections(projections)
    assert_close(found, K)
    assert_close(pose, cameras.cam_from_world)


def test_a_rotation_that_is_none_goes_into_the_intrinsics_and_projects_the_same():
    cameras = arc_cameras(2, width=64, height=48, focal_px=90.0, distance=7.0)
    stretch = torch.diag(torch.tensor([1.0035, 1.0, 1.0], dtype=torch.float64))
    projections = cameras.intrinsics @ stretch @ cameras.cam_from_world[:, :3]
    K, pose = decompose_projections(projections)
    rotation = pose[:, :3, :3]
    assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(2, 3, 3))
    assert_close(torch.linalg.det(rotation), torch.ones(2, dtype=torch.float64))
    again = K @ pose[:, :3]
    assert_close(again / again[:, 2:, 3:], projections / projections[:, 2:, 3:])


def test_a_projection_of_no_camera_is_an_error():
    flat = torch.ones(1, 3, 4, dtype=torch.float64)
    with pytest.raises(ValueError, match="no inverse"):
        decompose_projections(flat)
