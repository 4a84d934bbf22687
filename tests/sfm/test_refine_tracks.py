import torch

from pimper_bench.metrics.similarity import similarity_between_points
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import rigid, transform
from pimper_torch.stages.sfm.colmap import bundle, observation_errors
from pimper_torch.stages.sfm.refine_tracks import refine_tracks
from tests.sfm import ball


def shape_error(points, truth):
    transferred = transform(similarity_between_points(points, truth), points)
    return (transferred - truth).norm(dim=1).median()


def camera_error(model, points):
    """Return the shape error of points triangulated from exact pixels by the model's cameras."""
    truth = ball.cameras_on_an_arc()
    pixels, _ = project(points, truth.cam_from_world, truth.intrinsics)
    each = torch.cartesian_prod(torch.arange(len(points)), torch.arange(6))
    exact = model.replace(
        points_world=points,
        observation_point=each[:, 0],
        observation_view=each[:, 1],
        observation_pixels=pixels[each[:, 1], each[:, 0]],
    )
    return shape_error(bundle(exact, 0.5, cameras=False).points_world, points)


def found_by_features(generator, noise_px=0.5, fraction=0.6):
    """Adjust the truth to noisy features, as structure from motion does."""
    cameras = ball.cameras_on_an_arc()
    points = ball.points_on_the_ball(200, generator)
    model = ball.model_of(cameras, points, generator, noise_px, fraction)
    return cameras, points, bundle(model, 1.0)


def test_camera_errors_shrink_fivefold_under_changing_light(generator):
    cameras, points, model = found_by_features(generator)
    better = refine_tracks(ball.photographs(cameras), model, 1)
    assert camera_error(better, points) < camera_error(model, points) / 5


def test_missing_observations_are_recovered(generator):
    cameras, _, model = found_by_features(generator, fraction=0.3)
    better = refine_tracks(ball.photographs(cameras), model, 1)
    assert len(better.observation_point) > 1.3 * len(model.observation_point)
    assert better.names == model.names
    assert observation_errors(better).median() < 0.15


def test_a_view_without_overlap_keeps_its_features_and_pose(generator):
    cameras, _, model = found_by_features(generator)
    views = ball.photographs(cameras)
    images = views.images.clone()
    images[4] = 0.2  # blank: no patch is observed
    better = refine_tracks(views.replace(images=images), model, 1)
    assert (better.observation_view == 4).sum() > 60
    others = [0, 1, 2, 3, 5]
    before, after = (torch.linalg.inv(one.cam_from_world)[:, :3, 3] for one in (model, better))
    transferred = transform(similarity_between_points(after[others], before[others]), after)
    assert (transferred[4] - before[4]).norm() < 0.1


def test_without_texture_nothing_changes(generator):
    cameras, _, model = found_by_features(generator)
    views = ball.photographs(cameras)
    plain = views.replace(images=torch.full_like(views.images, 0.3))
    assert refine_tracks(plain, model, 1) is model


def test_bundle_adjustment_of_exact_observations_recovers_the_truth(generator):
    cameras = ball.cameras_on_an_arc()
    points = ball.points_on_the_ball(100, generator)
    exact = ball.model_of(cameras, points, generator, noise_px=0.0)
    rotations = 0.01 * torch.randn(6, 3, 3, generator=generator, dtype=torch.float64)
    off = rigid(
        torch.linalg.matrix_exp(rotations - rotations.mT), torch.full((6, 3), 0.02).double()
    )
    moved = exact.replace(
        cam_from_world=off @ exact.cam_from_world,
        points_world=points + 0.02 * torch.randn(points.shape, generator=generator).double(),
    )
    found = bundle(moved, 0.5)
    assert observation_errors(found).max() < 1e-3
    assert shape_error(found.points_world, points) < 1e-4
    # Points only: cameras are fixed.
    found = bundle(exact.replace(points_world=points + 0.02), 0.5, cameras=False)
    torch.testing.assert_close(found.cam_from_world, exact.cam_from_world, rtol=0, atol=1e-12)
    assert found.lenses == exact.lenses
    torch.testing.assert_close(found.points_world, points, rtol=0, atol=1e-5)


def test_points_without_observations_are_removed_in_order(generator):
    model = ball.model_of(
        ball.cameras_on_an_arc(), ball.points_on_the_ball(20, generator), generator, 0.0
    )
    lonely = (model.observation_point == 7) & (model.observation_view > 0)
    fewer = model.without(lonely)
    assert len(fewer.points_world) == 19
    assert torch.equal(fewer.points_world[:7], model.points_world[:7])
    assert torch.equal(fewer.points_world[7:], model.points_world[8:])
    assert len(fewer.observation_point) == 19 * 6
    assert fewer.observed.all()
