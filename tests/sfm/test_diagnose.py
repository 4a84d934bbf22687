import pytest
import torch
from sparse_models import observed, views_of

from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.stages.sfm.camera_in_place import follows_camera_in_place
from pimper_torch.stages.sfm.diagnose import count_views_with_depth, diagnose, following_fraction
from pimper_torch.stages.sfm.reconstruct import Reconstruct
from pimper_torch.stages.sfm.sparse_scene import assemble_scene, write_model
from tests.sfm.captured import HEIGHT, UP, WIDTH, orbit, seen_of_ball


def noisy(cameras, points, generator, seen=None):
    """Return a model with a reprojection error of 0.3 px."""
    return observed(cameras, points, seen, noise_px=0.3, generator=generator)


def of_a_ball(generator, count=12, span_deg=330.0):
    cameras = orbit(count, span_deg)
    points = torch.randn(400, 3, generator=generator.clone_state(), dtype=torch.float64)
    points = points / points.norm(dim=1, keepdim=True)  # those of seen_of_ball
    seen = seen_of_ball(generator, 400, cameras).isfinite().all(dim=-1).mT
    return noisy(cameras, points, generator, seen)


def of_a_room(generator, count=12):
    """Return the wrong model of cropped photographs: a camera that shifts in front of a wall."""
    cameras = orbit(count, 330.0)
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, :2, 3] = torch.rand(count, 2, generator=generator, dtype=torch.float64) - 0.5
    poses[:, 2, 3] = 5.0
    points = 3 * torch.rand(400, 3, generator=generator, dtype=torch.float64) - 1.5
    points[:, 2] *= 0.02
    return noisy(cameras.replace(cam_from_world=poses), points, generator)


def test_a_consistent_model_of_a_rotating_camera_is_unreliable(generator):
    model = of_a_room(generator)
    assert following_fraction(model) > 0.9
    reason = diagnose(model, model.num_views)
    assert "only rotated" in reason
    for way in ("--masks", "plain cloth"):
        assert way in reason


@pytest.mark.parametrize(("count", "span_deg"), [(12, 330.0), (8, 50.0)])
def test_an_object_seen_from_around_is_reliable(generator, count, span_deg):
    model = of_a_ball(generator, count, span_deg)
    assert following_fraction(model) < 0.3
    assert diagnose(model, model.num_views) == ""


def test_points_on_a_table_seen_from_around_are_reliable(generator):
    cameras, up = orbit(12, 50.0), torch.tensor(UP, dtype=torch.float64)
    points = 2 * torch.rand(400, 3, generator=generator, dtype=torch.float64) - 1
    points -= (points @ up)[:, None] * up
    model = noisy(cameras, points, generator)
    assert following_fraction(model) < 0.3
    assert diagnose(model, 12) == ""


def test_a_model_of_less_than_half_of_the_photographs_is_unreliable(generator):
    model = of_a_ball(generator, 6, 90.0)
    assert diagnose(model, 11) == ""
    assert "6 of 13 photographs are registered and see" in diagnose(model, 13)


def test_an_unreliable_model_is_marked_in_the_scene_and_warned_of(generator, tmp_path):
    model = of_a_room(generator, 5)
    views = views_of(torch.rand(5, 3, HEIGHT, WIDTH, generator=generator))
    write_model(assemble_scene(views, model), tmp_path)
    with pytest.warns(PimperWarning, match="cameras are unreliable"):
        scene = Reconstruct()(views, tmp_path)
    assert "only rotated" in scene.diagnosis


def test_points_with_small_triangulation_angles_are_unreliable(generator):
    cameras = orbit(8, 3.9)
    points = 2 * torch.randn(400, 3, generator=generator, dtype=torch.float64)
    model = noisy(cameras, points, generator)
    assert following_fraction(model) < 0.5
    assert "0 of 8 photographs are registered and see most" in diagnose(model, 8)


def test_an_object_has_depth_and_a_background_only_if_alone(generator):
    detected, ball = of_a_room(generator), of_a_ball(generator, 6, 90.0)
    assert count_views_with_depth([detected, ball], 30) == [0, 6]
    assert count_views_with_depth([detected], 30) == [12]


def random_pixels(generator, count=500):
    return 600 * torch.rand(count, 2, generator=generator, dtype=torch.float64)


def mapped(matrix, pixels):
    """Return pixels mapped by a homography."""
    projective = homogeneous(pixels) @ matrix.mT
    return projective[:, :2] / projective[:, 2:]


def follows(first, second, generator):
    return follows_camera_in_place(first, second, first.new_tensor([300.0, 300]), 2.0)


def test_matches_of_a_rotating_camera_are_found_among_outliers(generator):
    first, second = random_pixels(generator), random_pixels(generator)
    panned = torch.tensor([[1.02, -0.03, 90], [0.03, 1.02, -40], [8e-5, -5e-5, 1]]).double()
    second[:100] = 300 + mapped(panned, first[:100] - 300)
    found = follows(first, second, generator)
    assert found[:100].all()
    assert found[100:].double().mean() < 0.02


@pytest.mark.parametrize(
    "moved",
    [
        [[0.83, 0.56, 0], [-0.56, 0.83, 0], [0, 0, 1]],  # a roll by 34 degrees
        [[1.5, 0, 0], [0, 1.5, 0], [0, 0, 1]],
        [[1.1, -0.2, 30], [0.1, 0.9, -20], [1e-4, -2e-4, 1]],  # a plane, seen from around
    ],
)
def test_other_motions_do_not_fit_a_rotating_camera(generator, moved):
    first = random_pixels(generator)
    found = follows(first, mapped(torch.tensor(moved).double(), first), generator)
    assert found.double().mean() < 0.2
    assert not follows(first[:1], first[:1], generator).any()
