import pytest
import torch
from torch.testing import assert_close

from pimper_torch.geometry.local_frame import NO_OFFSET, from_local, local_origin, to_local
from pimper_torch.geometry.rigid import transform
from tests.coarse.ball import all_round

UTM = (448231.25, 5411923.5, 312.125)
OFFSETS = [UTM, (0.0, 0.0, -3e7)]


def cameras_and_points(offset):
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    return from_local(all_round().cam_from_world, offset), points + points.new_tensor(offset)


@pytest.mark.parametrize("offset", OFFSETS)
def test_a_far_scene_gets_an_origin_among_its_points(offset):
    poses, points = cameras_and_points(offset)
    found = local_origin(poses, points)
    assert max(abs(one - other) for one, other in zip(found, offset, strict=True)) < 1.5
    assert found == tuple(map(round, found))  # integers: cameras are 4 units away
    near = transform(to_local(poses, found), points - points.new_tensor(found))
    assert_close(near, transform(poses, points), rtol=0, atol=1e-7)  # 3e7 in double precision


@pytest.mark.parametrize("offset", [NO_OFFSET, (-20.0, 20.0, 15.0)])
def test_a_scene_near_its_origin_keeps_it(offset):
    assert local_origin(*cameras_and_points(offset)) == NO_OFFSET


def test_the_origin_is_robust_to_outliers_and_needs_no_points():
    poses, points = cameras_and_points(UTM)
    plain = local_origin(poses, points)
    points[:5] = 1e9
    points[5:9] = torch.nan
    close = zip(local_origin(poses, points), plain, strict=True)
    assert all(abs(one - other) <= 1 for one, other in close)
    alone = local_origin(poses, points[:0])
    assert max(abs(one - other) for one, other in zip(alone, UTM, strict=True)) < 4


def test_camera_positions_keep_double_precision():
    cameras = all_round()
    placed = from_local(cameras.cam_from_world.float(), UTM)
    centers = cameras.replace(cam_from_world=placed).centers_world
    wanted = cameras.centers_world + centers.new_tensor(UTM)
    assert float((centers - wanted).abs().max()) < 2e-6  # 4 units in single precision
