import math

import pytest
import torch
from planarity import dihedrals, planar_faces
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.subdivision import subdivide
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import InputError

SIZE = (1.0, 1.5, 3.0)

QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


def box(generator, noise=0.0, lean_deg=0.0, spacing=0.03):
    """A closed box of SIZE, one pair of sides leaning, with noise on its vertices."""
    corners = torch.tensor([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]).double()
    corners = corners * torch.tensor(SIZE).double()
    corners[:, 0] += math.tan(math.radians(lean_deg)) * corners[:, 1]
    faces = torch.tensor([part for a, b, c, d in QUADS for part in ((a, b, c), (a, c, d))])
    dense = subdivide(corners, faces, torch.full((12,), spacing).double())
    volume = (dense.points[dense.faces].det() / 6).sum()
    rotated = dense.faces if volume > 0 else dense.faces.flip(1)
    shake = torch.randn(dense.points.shape, generator=generator, dtype=torch.float64)
    return Mesh(vertices_world=dense.points + noise * shake, faces=rotated)


def test_an_exact_box_has_six_flat_sides_at_right_angles(generator):
    mesh = box(generator)
    sides = planar_faces(mesh, generator)
    assert len(sides) == 6
    # Except a line along the edges, where smoothed normals mix both sides.
    assert 0.97 * len(mesh.faces) < sum(len(side.faces) for side in sides) <= len(mesh.faces)
    assert max(side.rms for side in sides) < 1e-9
    found = sorted(side.sides for side in sides)
    expected = sorted([(1.5, 1.0)] * 2 + [(3.0, 1.0)] * 2 + [(3.0, 1.5)] * 2)
    assert_close(torch.tensor(found), torch.tensor(expected), atol=0.03, rtol=0)
    angles = dihedrals(mesh, sides)
    assert len(angles) == 12
    assert all(abs(each.angle_deg - 90) < 1e-6 for each in angles)
    # Outward: away from the centre.
    centre = torch.tensor(SIZE).double() / 2
    assert all((side.point - centre) @ side.normal > 0 for side in sides)


def test_noise_is_measured_as_generated(generator):
    noise = 0.004
    sides = planar_faces(box(generator, noise=noise), generator)
    assert len(sides) == 6
    for side in sides:
        assert side.rms == pytest.approx(noise, rel=0.08)
        assert side.p95 == pytest.approx(1.96 * noise, rel=0.08)
        assert side.edge == pytest.approx(math.prod(side.sides) ** 0.5)


def test_a_bulge_is_found_on_its_side(generator):
    mesh = box(generator)
    vertices = mesh.vertices_world.clone()
    top = vertices[:, 2] > SIZE[2] - 1e-9
    across = torch.sin(torch.pi * vertices[:, 0]) * torch.sin(torch.pi * vertices[:, 1] / 1.5)
    vertices[top, 2] += 0.02 * across[top]
    sides = planar_faces(mesh.replace(vertices_world=vertices), generator)
    (bulged,) = [side for side in sides if side.normal[2] > 0.9]
    others = [side.rms for side in sides if side.normal[2] < 0.9]
    assert 0.003 < bulged.rms < 0.006  # the bulge's spread is 0.0057 with its rim
    assert max(others) < 1e-9


def test_a_ball_has_no_flat_sides(generator):
    vertices, faces = icosphere(4)
    sides = planar_faces(
        Mesh(vertices_world=vertices, faces=faces), generator, band=0.002, min_fraction=0.04
    )
    assert len(sides) == 0


def test_a_mesh_without_area_is_refused(generator):
    flat = Mesh(vertices_world=torch.zeros(3, 3), faces=torch.tensor([[0, 1, 2]]))
    with pytest.raises(InputError, match="without area"):
        planar_faces(flat, generator)
