import pytest
import torch
from scenes import CORNERS, FACETS, ball
from torch.testing import assert_close

from pimper_torch.geometry.nearest import NearestSurface, closest_on_triangles
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import InputError


@pytest.fixture
def square():
    return Mesh(vertices_world=CORNERS, faces=FACETS)


def brute_force(points, mesh):
    """Compare every point with every triangle, by a different algorithm."""
    a, b, c = mesh.vertices_world[mesh.faces].unbind(dim=1)
    best = torch.full((len(points),), torch.inf, dtype=torch.float64)
    # A corner has weight one; edges and the interior are quadratic problems.
    for first, second, third in zip(a, b, c, strict=True):
        for weights in _candidates(points, first, second, third):
            place = weights @ torch.stack([first, second, third])
            best = torch.minimum(best, (points - place).norm(dim=1))
    return best


def _candidates(points, a, b, c):
    corners = torch.stack([a, b, c])
    for chosen in ([0], [1], [2], [0, 1], [1, 2], [0, 2], [0, 1, 2]):
        kept = corners[chosen]
        edges = (kept[1:] - kept[0]).T
        inner = torch.zeros(len(points), 0, dtype=torch.float64)
        if len(chosen) > 1:
            inner = torch.linalg.lstsq(edges, (points - kept[0]).T, driver="gelsd").solution.T
        weights = torch.cat([1 - inner.sum(dim=1, keepdim=True), inner], dim=1)
        inside = (weights >= 0).all(dim=1, keepdim=True)
        full = torch.zeros(len(points), 3, dtype=torch.float64)
        full[:, chosen] = torch.where(inside, weights, torch.eye(len(chosen)).double()[0])
        yield full


def mixed_mesh(generator):
    """Return a hundred tiny triangles, a huge one, a needle, and one degenerate to a point."""
    centre = torch.rand(100, 1, 3, generator=generator, dtype=torch.float64)
    tiny = centre + 0.01 * torch.randn(100, 3, 3, generator=generator, dtype=torch.float64)
    huge = torch.tensor([[[-30.0, -30, -1], [40, -20, -1.5], [0, 50, -2]]], dtype=torch.float64)
    needle = torch.tensor([[[0.0, 0, 2], [9, 0, 2], [4, 1e-7, 2]]], dtype=torch.float64)
    point = torch.tensor([[[1.0, 1, 3]] * 3], dtype=torch.float64)
    corners = torch.cat([tiny, huge, needle, point])
    faces = torch.arange(3 * len(corners)).reshape(-1, 3)
    return Mesh(vertices_world=corners.reshape(-1, 3), faces=faces)


@pytest.mark.parametrize("spread", [0.02, 1.0, 20.0])
def test_distances_to_tiny_and_huge_triangles_are_those_of_brute_force(generator, spread):
    mesh = mixed_mesh(generator)
    points = 0.5 + spread * torch.randn(120, 3, generator=generator, dtype=torch.float64)
    found = NearestSurface(mesh).query(points)
    assert_close(found.distance, brute_force(points, mesh), rtol=1e-9, atol=1e-9)
    # Point and face are consistent, not only the distance.
    corners = mesh.vertices_world[mesh.faces[found.face]]
    assert_close(closest_on_triangles(points, corners), found.points)
    assert_close((points - found.points).norm(dim=1), found.distance)


def test_points_on_a_surface_far_from_the_origin_have_distance_zero():
    far = ball(center=(1e6, 1e6, 1e6))
    found = NearestSurface(far).query(far.vertices_world)
    assert float(found.distance.max()) < 1e-8  # float64 at a million


def test_no_points_have_no_distances(square):
    assert len(NearestSurface(square).query(torch.zeros(0, 3)).distance) == 0


def test_without_faces_the_vertices_are_the_surface(square):
    corners = square.replace(faces=torch.zeros(0, 3, dtype=torch.long))
    found = NearestSurface(corners).query(torch.tensor([[0.5, 0.4, 0.0]]).double())
    assert_close(found.distance, torch.tensor([0.41]).double().sqrt())
    assert found.face.tolist() in ([0], [1])


def test_unused_vertices_are_ignored(square):
    stray = torch.tensor([[5.0, 5, 5]], dtype=torch.float64)
    mesh = square.replace(vertices_world=torch.cat([square.vertices_world, stray]))
    assert float(NearestSurface(mesh).query(stray).distance) > 5


def test_an_empty_mesh_is_rejected():
    empty = Mesh(vertices_world=torch.zeros(0, 3), faces=torch.zeros(0, 3, dtype=torch.long))
    with pytest.raises(InputError, match="no vertices"):
        NearestSurface(empty)
