import pytest
import torch
from torch.testing import assert_close
from view_comparison import compare_in_view

from pimper_bench.metrics import relative_error
from pimper_bench.metrics.in_view import angles_deg
from pimper_bench.scenes.procedural_meshes import table
from pimper_bench.scenes.render_in_memory import EndlessPlane, render_shape
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.records import Mesh

IDENTITY = torch.eye(4, dtype=torch.float64)


@pytest.fixture
def cameras():
    return arc_cameras(1, width=40, height=30, focal_px=80.0, distance=5.0, span_deg=0.0)


def truth_of(shape, cameras):
    lights = torch.zeros(cameras.num_views, 4, dtype=torch.float64)
    return render_shape(shape, cameras, lights, torch.ones_like)


def raised(mesh, height):
    shift = torch.tensor([0.0, 0.0, height], dtype=torch.float64)
    return mesh.replace(vertices_world=mesh.vertices_world + shift)


def test_the_error_is_in_units_of_the_truth():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=torch.float64)
    # S - S_hat = (0, 1): norm 1. S - mean = (-0.5, 0.5): norm sqrt 0.5.
    assert_close(relative_error(2 * points, points), points.new_tensor(100 / 0.5**0.5))


def test_a_raised_table_has_the_error_computed_by_hand(cameras):
    truth = truth_of(EndlessPlane(), cameras)
    found = compare_in_view(
        raised(table(), 0.1),
        IDENTITY,
        cameras,
        0,
        truth.depth[0],
        normals_true=truth.normals_world[0],
    )
    # Every ray stops at depth 4.9 instead of 5, so S - S_hat is 0.1 of each ray; rays are
    # (u - 20, v - 15, 80) / 80, and S - mean is 5 times their first two parts.
    u = torch.arange(40).double() + 0.5 - 20
    v = torch.arange(30).double() + 0.5 - 15
    across = (u[None] ** 2 + v[:, None] ** 2) / 80**2
    expected = 100 * (0.01 * (1 + across)).sum().sqrt() / (25 * across).sum().sqrt()
    assert abs(found.relative_error - float(expected)) < 1e-3  # the ray caster uses float32
    assert found.coverage == 1.0
    assert found.mean_angle_deg < 1e-3
    assert found.num_pixels == 1200


def test_rays_that_miss_reduce_only_the_coverage(cameras):
    truth = truth_of(EndlessPlane(), cameras)
    corners = torch.tensor([[0.0, -9, 0], [9, -9, 0], [9, 9, 0], [0, 9, 0]], dtype=torch.float64)
    half = Mesh(vertices_world=corners, faces=torch.tensor([[0, 1, 2], [0, 2, 3]]))
    found = compare_in_view(half, IDENTITY, cameras, 0, truth.depth[0])
    assert found.coverage == 0.5
    assert found.relative_error < 1e-3
    assert torch.tensor(found.mean_angle_deg).isnan()


def test_angles_are_accurate_at_both_ends():
    base = torch.tensor([[0.0, 0.0, -1.0]] * 4, dtype=torch.float64)
    angle = torch.tensor([1e-9, 1.0, 2.0, torch.pi], dtype=torch.float64)
    rotated = torch.stack([angle.sin(), torch.zeros(4).double(), -angle.cos()], dim=1)
    assert_close(angles_deg(base, rotated), torch.rad2deg(angle), rtol=1e-9, atol=0)
