import pytest
import torch
from torch.nn.functional import normalize

from pimper_torch.bundle.adjust import Adjust, AdjustConfig
from pimper_torch.bundle.motions import (
    common_motions,
    middles_cam,
    move,
    pixel_slopes,
    scale_focals,
)
from pimper_torch.errors import ConfigError, InputError
from pimper_torch.geometry.frames import transform
from pimper_torch.geometry.projection import project

CONFIG = AdjustConfig(num_samples=2000)
ORIGIN = torch.zeros(3, dtype=torch.float64)


def shaken(cameras, seed, turn=0.004, shift=0.008, growth=0.0):
    """Turn cameras about the object, shift them, and stretch all focal lengths."""
    generator = torch.Generator().manual_seed(seed)
    draw = torch.randn(cameras.num_views, 6, generator=generator, dtype=torch.float64)
    sizes = torch.tensor([turn] * 3 + [shift] * 3).double()
    factors = torch.full((cameras.num_views,), growth).double()
    return cameras.replace(
        cam_from_world=move(cameras.cam_from_world, sizes * draw, ORIGIN),
        intrinsics=scale_focals(cameras.intrinsics, factors),
    )


def moved_together(cameras, motion):
    """Move all cameras alike: three turns, three shifts, and the distance."""
    step = common_motions(cameras, ORIGIN) @ torch.tensor(motion, dtype=torch.float64)
    return cameras.replace(cam_from_world=move(cameras.cam_from_world, step, ORIGIN))


def off_px(oracle, cameras, relative=False):
    """How far the surface's points are from where they should appear, mean over views.

    Relative to each other, that is but for a motion that all cameras share.
    """
    points = normalize(oracle.patches.coarse.mesh.vertices_world, dim=1)
    true = oracle.cameras
    ours, _ = project(points, true.cam_from_world, true.intrinsics)
    theirs, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    off = theirs - ours
    if relative:
        frames = true.cam_from_world
        slopes = pixel_slopes(
            transform(frames, points), true.intrinsics, middles_cam(frames, ORIGIN)
        )
        columns = slopes[..., :6] @ common_motions(true, ORIGIN)[:, None]
        matrix, flat = columns.reshape(-1, 7), off.reshape(-1, 1)
        off = (flat - matrix @ torch.linalg.lstsq(matrix, flat).solution).reshape(off.shape)
    return off.norm(dim=-1).mean()


def adjusted(oracle, cameras, found=None, config=CONFIG):
    return Adjust(config)(
        oracle.views, cameras, oracle.seen(cameras), found or oracle.photometry, oracle.lenses
    )


def test_shaken_cameras_with_a_wrong_focal_length_come_back(oracle):
    cameras = shaken(oracle.cameras, 2, growth=0.01)
    assert off_px(oracle, cameras, relative=True) > 1
    found = adjusted(oracle, cameras)
    assert found.kept.all()
    assert found.reason == ""
    assert off_px(oracle, found.cameras, relative=True) < 0.05  # 0.014 measured, from 1.5
    assert (found.held_after < 0.2 * found.held_before).all()
    assert found.fit_after < 0.2 * found.fit_before
    # One lens, one focal length; what all share remains as it came.
    assert found.focal_growth.std() < 1e-6
    assert off_px(oracle, found.cameras) < 0.7
    assert found.common == 4  # turns about the ball's centre, and the distance with the focal


def test_true_cameras_stay_where_they_are(oracle):
    found = adjusted(oracle, oracle.cameras)
    assert not found.kept.any()
    assert "held out" in found.reason
    assert found.motion_px.max() < 0.02
    assert (found.cameras.cam_from_world == oracle.cameras.cam_from_world).all()
    assert (found.cameras.intrinsics == oracle.cameras.intrinsics).all()


def test_a_shift_that_all_share_is_undone_because_the_ball_is_not_there(oracle):
    cameras = moved_together(oracle.cameras, [0, 0, 0, 0, 0, 0.04, 0])
    assert off_px(oracle, cameras) > 1
    found = adjusted(oracle, cameras, config=AdjustConfig(num_samples=2000, focals=False))
    assert found.kept.all()
    assert off_px(oracle, found.cameras) < 0.1


def test_a_turn_that_all_share_is_left_because_a_ball_does_not_tell_it(oracle):
    cameras = moved_together(oracle.cameras, [0.012, -0.008, 0.006, 0, 0, 0, 0])
    assert off_px(oracle, cameras) > 0.8
    found = adjusted(oracle, cameras)
    assert found.motion_px.max() < 0.1


def test_one_camera_that_is_off_is_mended_alone(oracle):
    step = torch.zeros(oracle.cameras.num_views, 6, dtype=torch.float64)
    step[2, 1], step[2, 3] = 0.01, 0.015
    cameras = oracle.cameras.replace(
        cam_from_world=move(oracle.cameras.cam_from_world, step, ORIGIN)
    )
    found = adjusted(oracle, cameras, config=AdjustConfig(num_samples=2000, focals=False))
    assert found.kept[2]
    assert found.motion_px[2] > 5 * found.motion_px[[0, 1, 3, 4, 5, 6]].max()
    assert off_px(oracle, found.cameras, relative=True) < 0.05
    assert (found.cameras.intrinsics == cameras.intrinsics).all()


def with_lights(oracle, change):
    buckets = tuple(
        bucket.replace(lights_patch=change(bucket.lights_patch))
        for bucket in oracle.photometry.buckets
    )
    return oracle.photometry.replace(buckets=buckets)


def test_views_that_are_brighter_than_said_move_no_camera(oracle):
    factors = torch.linspace(0.7, 1.4, oracle.cameras.num_views).double()
    found = adjusted(
        oracle, oracle.cameras, with_lights(oracle, lambda lights: lights * factors[:, None])
    )
    assert not found.kept.any()
    assert found.motion_px.max() < 0.05


def test_wrong_photometry_moves_no_camera(oracle):
    # The lights of other views: nothing fits, and no pose mends that.
    wrong = with_lights(oracle, lambda lights: lights.roll(2, dims=1))
    found = adjusted(oracle, oracle.cameras, wrong)
    assert not found.kept.any()
    assert found.reason
    assert (found.cameras.cam_from_world == oracle.cameras.cam_from_world).all()


def test_the_draw_is_repeatable(oracle):
    cameras = shaken(oracle.cameras, 3)
    config = AdjustConfig(num_samples=500, iterations=2)
    one, other = (adjusted(oracle, cameras, config=config) for _ in range(2))
    assert (one.cameras.cam_from_world == other.cameras.cam_from_world).all()


def test_without_samples_nothing_moves(oracle):
    blind = oracle.photometry.replace(
        buckets=tuple(
            bucket.replace(valid=torch.zeros_like(bucket.valid))
            for bucket in oracle.photometry.buckets
        )
    )
    found = adjusted(oracle, oracle.cameras, blind)
    assert not found.kept.any()
    assert "too few" in found.reason


def test_records_of_other_views_are_refused(oracle):
    with pytest.raises(InputError, match="6 cameras"):
        Adjust(CONFIG)(
            oracle.views,
            oracle.cameras.take(list(range(6))),
            oracle.seen(oracle.cameras),
            oracle.photometry,
        )


def test_impossible_settings_are_refused():
    with pytest.raises(ConfigError, match="held_out"):
        AdjustConfig(held_out=1.0)
