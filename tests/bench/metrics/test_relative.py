import pytest
import torch
from comparison import compare_in_view
from torch.testing import assert_close

from pimper_bench.metrics import relative_error
from pimper_bench.metrics.in_view import angles_deg
from pimper_bench.scenes.procedural_meshes import icosphere, table
from pimper_bench.scenes.render_in_memory import EndlessPlane, Sphere, render_shape
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.ground.geometry.rigid import rigid, transform
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import InputError

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


def test_a_shifted_square_has_the_error_computed_by_hand():
    square = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], dtype=torch.float64)
    shifted = square + square.new_tensor([0.0, 0.0, 0.1])
    # ||shift||_F = sqrt(4 * 0.01) = 0.2; corners are sqrt 2 from the centre: sqrt(4 * 2).
    assert_close(relative_error(shifted, square), square.new_tensor(100 * 0.2 / 8**0.5))


def test_the_error_is_in_units_of_the_truth_not_of_the_estimate():
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
    assert abs(found.relative_error - float(expected)) < 1e-3  # float32 of the ray caster
    assert found.coverage == 1.0
    assert found.mean_angle_deg < 1e-3
    assert found.num_pixels == 1200


def test_a_blown_up_sphere_is_off_by_its_growth(cameras):
    truth = truth_of(Sphere(), cameras)
    vertices, faces = icosphere(6)
    nearer = Mesh(vertices_world=vertices * 1.02, faces=faces)
    same = Mesh(vertices_world=vertices, faces=faces)
    found, exact = (
        compare_in_view(mesh, IDENTITY, cameras, 0, truth.depth[0]) for mesh in (nearer, same)
    )
    assert exact.relative_error < 0.2  # facets; a thin ring of rays grazes the rim
    rays = found.relative_error
    centre = compare_in_view(
        nearer,
        IDENTITY,
        cameras,
        0,
        truth.depth[0],
        where=truth.normals_world[0][..., 2] > 0.95,
    )
    # Near the centre rays and normals are alike, so points move by 0.02 / cos of 1.
    assert rays > 2
    points = truth.normals_world[0][truth.normals_world[0][..., 2] > 0.95]
    spread = (points - points.mean(dim=0)).square().sum(dim=1).mean().sqrt()
    assert abs(centre.relative_error / float(100 * 0.02 / spread) - 1) < 0.05


def test_an_estimate_in_another_frame_is_transferred_to_the_truth(cameras):
    truth = truth_of(Sphere(), cameras)
    vertices, faces = icosphere(6)
    angle = torch.tensor(0.7, dtype=torch.float64)
    rotation = torch.linalg.matrix_exp(
        angle * torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]], dtype=torch.float64)
    )
    truth_from_world = rigid(0.25 * rotation, torch.tensor([1.0, 2, 3], dtype=torch.float64))
    world_from_truth = torch.linalg.inv(truth_from_world)
    mesh = Mesh(
        vertices_world=transform(world_from_truth, vertices),
        faces=faces,
        normals_world=vertices @ rotation,
    )
    found = compare_in_view(
        mesh,
        truth_from_world,
        cameras,
        0,
        truth.depth[0],
        normals_true=truth.normals_world[0],
        where=truth.normals_world[0][..., 2] > 0.3,
    )
    assert found.relative_error < 0.1
    assert found.coverage == 1.0
    assert found.mean_angle_deg < 0.1


def test_rays_that_miss_count_against_the_coverage_alone(cameras):
    truth = truth_of(EndlessPlane(), cameras)
    corners = torch.tensor([[0.0, -9, 0], [9, -9, 0], [9, 9, 0], [0, 9, 0]], dtype=torch.float64)
    half = Mesh(vertices_world=corners, faces=torch.tensor([[0, 1, 2], [0, 2, 3]]))
    found = compare_in_view(half, IDENTITY, cameras, 0, truth.depth[0])
    assert found.coverage == 0.5
    assert found.relative_error < 1e-3
    assert torch.tensor(found.mean_angle_deg).isnan()


def test_tilted_normals_are_off_by_their_tilt(cameras):
    truth = truth_of(EndlessPlane(), cameras)
    mesh = table()
    tilt = torch.deg2rad(torch.tensor(20.0, dtype=torch.float64))
    normal = torch.stack([tilt.sin(), torch.zeros_like(tilt), tilt.cos()])
    mesh = mesh.replace(normals_world=normal.expand(4, 3).clone())
    found = compare_in_view(
        mesh, IDENTITY, cameras, 0, truth.depth[0], normals_true=truth.normals_world[0]
    )
    assert abs(found.mean_angle_deg - 20) < 1e-3
    assert abs(found.median_angle_deg - 20) < 1e-3


def test_angles_are_accurate_at_both_ends():
    base = torch.tensor([[0.0, 0.0, -1.0]] * 4, dtype=torch.float64)
    angle = torch.tensor([1e-9, 1.0, 2.0, torch.pi], dtype=torch.float64)
    rotated = torch.stack([angle.sin(), torch.zeros(4).double(), -angle.cos()], dim=1)
    assert_close(angles_deg(base, rotated), torch.rad2deg(angle), rtol=1e-9, atol=0)


def test_a_mesh_elsewhere_is_refused(cameras):
    truth = truth_of(EndlessPlane(), cameras)
    aside = table(0.1)
    aside = aside.replace(vertices_world=aside.vertices_world + 100)
    with pytest.raises(InputError, match="Check the frame"):
        compare_in_view(aside, IDENTITY, cameras, 0, truth.depth[0])
