import math

import pytest
import torch
from sparse_models import observed
from torch.testing import assert_close

from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.quarter_turns import turned_pose
from pimper_torch.geometry.rigid import invert_rigid, rigid, transform
from pimper_torch.stages.sfm.upright import level_up, rotate_upright


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(92)


def standing(num_views=12, span_deg=330.0, elevation_deg=25.0, **more):
    """Return cameras around an object whose up is y."""
    return arc_cameras(
        num_views,
        width=80,
        height=60,
        focal_px=90.0,
        distance=3.0,
        span_deg=span_deg,
        elevation_deg=elevation_deg,
        sway_deg=0.0,
        **more,
    )


def rolled(poses, angles):
    """Roll cameras about their optical axes, in radians."""
    roll = torch.eye(4).double().repeat(len(poses), 1, 1)
    roll[:, 0, 0] = roll[:, 1, 1] = angles.cos()
    roll[:, 1, 0], roll[:, 0, 1] = angles.sin(), -angles.sin()
    return roll @ poses


def model_of(cameras, points, world_from_true):
    """Return a model in the given frame; every view sees every point."""
    placed = cameras.cam_from_world.double() @ invert_rigid(world_from_true)
    return observed(
        cameras.to(torch.float64).replace(cam_from_world=placed),
        transform(world_from_true, points.double()),
    )


def any_frame(generator):
    Q, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    return rigid(Q * torch.linalg.det(Q), torch.tensor([0.3, -2.0, 1.0]).double())


def off_deg(direction, truth=(0.0, 1.0, 0.0)):
    cosine = direction.double() @ torch.tensor(truth).double()
    return math.degrees(math.acos(min(1.0, float(cosine))))


@pytest.mark.parametrize("span_deg", [330.0, 60.0])
@pytest.mark.parametrize("elevation_deg", [-10.0, 75.0])
def test_level_cameras_give_the_up_direction(span_deg, elevation_deg):
    # Along an arc of 60 degrees, the tilt of the y axes has a small weight against the x axes.
    poses = standing(span_deg=span_deg, elevation_deg=elevation_deg).cam_from_world
    assert off_deg(level_up(poses)) < (0.01 if span_deg > 300 else 1.0)


def test_handheld_cameras_give_the_up_direction_to_a_degree(generator):
    roll = math.radians(3.0) * torch.randn(24, generator=generator, dtype=torch.float64)
    poses = rolled(standing(24, elevation_deg=30.0).cam_from_world, roll)
    assert off_deg(level_up(poses)) < 1.5


def test_quarter_turns_of_a_third_of_the_cameras_do_not_matter():
    poses = standing(12).cam_from_world
    poses = torch.stack([turned_pose(one, view % 3 == 0) for view, one in enumerate(poses)])
    assert off_deg(level_up(poses)) < 1.0


def test_without_lateral_motion_up_is_that_of_the_cameras():
    poses = standing(3, span_deg=1e-6, elevation_deg=0.0).cam_from_world
    assert off_deg(level_up(poses)) < 0.01


def test_up_is_the_normal_of_the_supporting_plane(generator):
    # Cameras are tilted by 5 degrees, all equally, as at a turntable; the table is not.
    cameras = standing(12, elevation_deg=30.0)
    leaning = rolled(cameras.cam_from_world, torch.full((12,), math.radians(5.0)).double())
    table = torch.rand(200, 3, generator=generator).double() * 2 - 1
    table[:, 1] = -0.5
    above = 0.3 * torch.randn(300, 3, generator=generator).double().clamp(-1.5, 1.5)
    points, frame = torch.cat([above, table]), any_frame(generator)
    found = rotate_upright(model_of(cameras.replace(cam_from_world=leaning), points, frame))
    assert_close(found.points_world[300:, 1].std(), torch.tensor(0.0).double(), atol=1e-9, rtol=0)
    assert bool((found.points_world[:300, 1].mean() > found.points_world[300:, 1]).all())
    assert bool((invert_rigid(found.cam_from_world)[:, 1, 3] > found.points_world[300, 1]).all())


def test_a_wall_is_not_mistaken_for_the_ground(generator):
    cameras = standing(9, span_deg=60.0, elevation_deg=0.0)
    wall = torch.rand(300, 3, generator=generator).double() * 2 - 1
    wall[:, 2] = -0.2
    frame = any_frame(generator)
    found = rotate_upright(model_of(cameras, wall, frame))
    assert_close(found.points_world[:, 2].std(), torch.tensor(0.0).double(), atol=1e-3, rtol=0)


def test_cameras_are_on_the_side_of_z_and_a_model_is_only_rotated(generator):
    cameras = standing(9, span_deg=60.0)
    points, frame = torch.randn(50, 3, generator=generator), any_frame(generator)
    model = model_of(cameras, points, frame)
    found = rotate_upright(model)
    eyes = invert_rigid(found.cam_from_world)[:, :3, 3]
    assert bool((eyes[:, 2] - found.points_world[:, 2].mean() > 0).all())
    assert_close(eyes.norm(dim=1), invert_rigid(model.cam_from_world)[:, :3, 3].norm(dim=1))
    seen = [
        transform(each.cam_from_world, each.points_world.expand(9, -1, 3))
        for each in (model, found)
    ]
    assert_close(*seen)
    again = rotate_upright(found)
    assert_close(again.points_world, found.points_world, atol=1e-6, rtol=0)
