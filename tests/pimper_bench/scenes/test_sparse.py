import pytest
import torch
from torch.testing import assert_close

from pimper_bench.scenes.render_in_memory import Sphere, render_shape
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.textures import random_speckle
from pimper_bench.scenes.true_clouds import sparse_scene
from pimper_torch.geometry.projection import project, triangulate_rays


def exact_cloud(*inputs, **settings):
    return sparse_scene(*inputs, dtype=torch.float64, **settings)


@pytest.fixture
def scene(generator):
    cameras = arc_cameras(6, width=80, height=60, focal_px=90.0, distance=4.0, span_deg=60.0)
    lights = torch.rand(6, 4, generator=generator, dtype=torch.float64)
    return render_shape(Sphere(), cameras, lights, random_speckle(generator))


def test_points_are_on_the_surface_and_project_to_their_observations(scene, generator):
    sparse = exact_cloud(scene, 150, generator)
    assert len(sparse.points_world) == 150
    assert_close(sparse.points_world.norm(dim=1), torch.ones(150, dtype=torch.float64))
    pixels, _ = project(
        sparse.points_world, sparse.cameras.cam_from_world, sparse.cameras.intrinsics
    )
    expected = pixels[sparse.observation_view, sparse.observation_point]
    assert_close(sparse.observation_pixels, expected)
    assert sparse.observed.sum(dim=1).min() >= 3
    assert sparse.reprojection_errors_px.max() < 1e-9


def test_no_point_is_observed_from_behind_the_sphere(scene, generator):
    sparse = exact_cloud(scene, 300, generator)
    points = sparse.points_world[sparse.observation_point]
    toward = sparse.cameras.centers_world[sparse.observation_view] - points
    assert ((points * toward).sum(dim=1) > 0).all()
    # Cameras at both ends of the arc see different parts.
    assert not sparse.observed.all()
    fraction = sparse.observed.double().mean()
    assert fraction > 0.6


def test_noise_of_observations_propagates_to_points(scene, generator):
    sparse = exact_cloud(scene, 300, generator, noise_px=0.5)
    off = (sparse.points_world.norm(dim=1) - 1).abs()
    assert 1e-4 < off.mean() < 0.02
    # A track of v views keeps 2v - 3 of 2v noisy numbers: below 0.5 sqrt(pi / 2).
    assert 0.3 < sparse.reprojection_errors_px.mean() < 0.63


def test_rays_through_noiseless_pixels_intersect_in_their_points(generator):
    cameras = arc_cameras(4, width=80, height=60, focal_px=90.0, distance=4.0)
    points = torch.rand(30, 3, generator=generator, dtype=torch.float64) - 0.5
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    seen = torch.ones(30, 4, dtype=torch.bool)
    seen[:10, 0] = False
    pixels = pixels.movedim(0, 1).clone()
    pixels[:10, 0] = -1e4  # unobserved, so it must not count
    assert_close(triangulate_rays(cameras, pixels, seen), points)


def test_a_cloud_is_float32_like_that_of_structure_from_motion(scene, generator):
    sparse = sparse_scene(scene, 10, generator)
    assert sparse.points_world.dtype == torch.float32
    assert sparse.cameras.cam_from_world.dtype == torch.float32
    assert sparse.observation_pixels.dtype == torch.float32
