import pytest
import torch
from torch.testing import assert_close

from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry import projection
from pimper_torch.geometry.projection import project, rays_through, triangulation_angles


@pytest.fixture
def points():
    generator = torch.Generator().manual_seed(121)
    return torch.rand(40, 3, generator=generator, dtype=torch.float64) - 0.5


def test_a_ray_at_its_depth_is_the_point(points):
    cameras = arc_cameras(3, width=64, height=48, focal_px=70.0, distance=4.0)
    pixels, depth = project(points, cameras.cam_from_world, cameras.intrinsics)
    assert pixels.shape == (3, 40, 2)
    rays = rays_through(pixels, cameras.cam_from_world, cameras.intrinsics)
    found = cameras.centers_world[:, None] + depth[..., None] * rays
    assert_close(found, points.expand(3, -1, -1))


def test_skewed_intrinsics_keep_the_round_trip(points):
    K = torch.tensor([[90.0, 2.0, 30], [0, 85, 20], [0, 0, 1]], dtype=torch.float64)
    cam_from_world = torch.eye(4, dtype=torch.float64)
    cam_from_world[2, 3] = 3
    pixels, depth = project(points, cam_from_world, K)
    center = torch.tensor([0.0, 0.0, -3.0], dtype=torch.float64)
    assert_close(center + depth[:, None] * rays_through(pixels, cam_from_world, K), points)


def test_points_behind_the_camera_give_finite_values_and_gradients():
    K = torch.tensor([[90.0, 0, 30], [0, 85, 20], [0, 0, 1]], dtype=torch.float64)
    points = torch.tensor([[1.0, 1.0, 0.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0]]).double()
    points.requires_grad_()
    pixels, depth = project(points, torch.eye(4, dtype=torch.float64), K)
    assert depth.tolist() == [0.0, -2.0, 0.0]
    assert pixels.isfinite().all()
    pixels.sum().backward()
    assert points.grad.isfinite().all()


def test_triangulation_angle_is_the_largest_between_observing_rays(monkeypatch):
    generator = torch.Generator().manual_seed(122)
    monkeypatch.setattr(projection, "_POINTS", 3)  # in several chunks
    centers = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    points = torch.randn(7, 3, generator=generator, dtype=torch.float64)
    observed = torch.rand(7, 5, generator=generator) < 0.6
    observed[0] = False
    found = triangulation_angles(points, observed, centers)
    for point in range(7):
        widest = 0.0
        seeing = observed[point].nonzero()[:, 0].tolist()
        for a in seeing:
            for b in seeing:
                rays = points[point] - centers[a], points[point] - centers[b]
                cosine = torch.cosine_similarity(*rays, dim=0).clamp(-1, 1)
                widest = max(widest, float(cosine.acos()))
        # The arc cosine near 1 turns float64's rounding into 1e-8.
        assert_close(float(found[point]), widest, atol=1e-7, rtol=0)
