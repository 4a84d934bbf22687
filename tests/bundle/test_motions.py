import torch
from torch.testing import assert_close

from pimper_torch.bundle.motions import (
    common_motions,
    lens_groups,
    middles_cam,
    motion_between,
    move,
    pixel_slopes,
    scale_focals,
)
from pimper_torch.geometry.frames import rigid, transform
from pimper_torch.geometry.projection import project
from pimper_torch.scenes.cameras import arc_cameras

MIDDLE = torch.tensor([0.2, -0.1, 0.3], dtype=torch.float64)


def some_cameras():
    return arc_cameras(3, width=160, height=120, focal_px=300.0, distance=3.5, sway_deg=8.0)


def test_slopes_of_pixels_are_those_of_moving_and_projecting():
    cameras, generator = some_cameras(), torch.Generator().manual_seed(0)
    points = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    frame, K = cameras.cam_from_world[:1], cameras.intrinsics[:1].clone()
    K[0, 0, 1] = 3.0  # a skew

    def pixels(motion):
        where = move(frame, motion[None, :6], MIDDLE)
        return project(points, where, scale_focals(K, motion[6:]))[0][0]

    expected = torch.autograd.functional.jacobian(pixels, torch.zeros(7).double())
    found = pixel_slopes(transform(frame, points), K, middles_cam(frame, MIDDLE))
    assert_close(found[0], expected)


def test_a_motion_is_read_off_the_poses_it_leads_to():
    cameras, generator = some_cameras(), torch.Generator().manual_seed(1)
    motion = 0.2 * torch.randn(3, 6, generator=generator, dtype=torch.float64)
    after = move(cameras.cam_from_world, motion, MIDDLE)
    assert_close(motion_between(cameras.cam_from_world, after, MIDDLE), motion)
    still = motion_between(cameras.cam_from_world, cameras.cam_from_world, MIDDLE)
    assert_close(still, torch.zeros_like(still))


def test_common_motions_are_those_of_the_world_as_a_whole():
    cameras, size = some_cameras(), 1e-5
    points = torch.randn(10, 3, generator=torch.Generator().manual_seed(2)).double()
    before, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    common = common_motions(cameras, MIDDLE)
    for column in range(7):
        step = size * torch.eye(7, dtype=torch.float64)[column]
        skew = torch.zeros(3, 3, dtype=torch.float64)
        skew[[2, 0, 1], [1, 2, 0]] = step[:3]
        skew = skew - skew.mT
        turn = torch.linalg.matrix_exp(skew)
        world = rigid(turn, MIDDLE + step[3:6] - turn @ MIDDLE)
        shrunk = MIDDLE + (transform(world, points) - MIDDLE) / (1 + step[6])
        expected, _ = project(shrunk, cameras.cam_from_world, cameras.intrinsics)
        moved = move(cameras.cam_from_world, common @ step, MIDDLE)
        found, _ = project(points, moved, cameras.intrinsics)
        assert (expected - before).norm(dim=-1).mean() > 20 * size
        assert_close(found - before, expected - before, atol=1e-2 * size, rtol=1e-3)


def test_lenses_are_numbered_from_zero():
    assert lens_groups(torch.tensor([7, 2, 7, 9])).tolist() == [1, 0, 1, 2]
