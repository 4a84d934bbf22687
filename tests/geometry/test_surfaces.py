import pytest
import torch
import trimesh
from slopes import normals_from_slopes
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.surfaces import (
    barycentric_2d,
    face_normals,
    slopes_from_normals,
    unit_face_normals,
    vertex_normals,
)

# Two triangles that share the edge 0-2, and a separate third one.
FACES = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6]])


def test_slopes_and_normals_are_inverse(generator):
    slopes = 3 * torch.randn(50, 2, generator=generator, dtype=torch.float64)
    normals = normals_from_slopes(slopes)
    assert (normals[:, 2] < 0).all()
    assert_close(normals.norm(dim=1), torch.ones(50, dtype=torch.float64))
    assert_close(slopes_from_normals(normals), slopes)


def test_slopes_are_the_derivatives_of_the_depth_of_a_sphere(generator):
    xy = (torch.rand(50, 2, generator=generator, dtype=torch.float64) - 0.5).requires_grad_()
    depth = -(1 - xy.square().sum(dim=1)).sqrt()  # the near half: z increases away from the viewer
    (slopes,) = torch.autograd.grad(depth.sum(), xy)
    normals = torch.cat([xy, depth[:, None]], dim=1).detach()  # outward, so n_z < 0
    assert_close(slopes_from_normals(normals), slopes)


def test_steep_and_averted_normals_get_the_steepest_slope_of_their_direction():
    normals = torch.tensor([[1.0, 0.0, -1e-3], [-0.9, 0.0, 0.436], [0.0, 0.0, 1.0]]).double()
    slopes = slopes_from_normals(normals, steepest=5.0)
    assert_close(slopes[0], torch.tensor([5.0, 0.0]).double())
    assert_close(slopes[1], torch.tensor([-4.5, 0.0]).double())
    assert_close(slopes[2], torch.zeros(2).double())


def test_face_normals_have_twice_the_area_and_point_out():
    box = trimesh.creation.box(extents=(1.0, 2.0, 3.0))
    vertices, faces = torch.tensor(box.vertices), torch.tensor(box.faces)
    normals = face_normals(vertices, faces)
    assert_close(normals.norm(dim=1).sum() / 2, torch.tensor(22.0, dtype=torch.float64))
    assert ((vertices[faces].mean(dim=1) * normals).sum(dim=1) > 0).all()


def test_vertex_normals_weigh_faces_by_area(generator):
    vertices = torch.randn(7, 3, generator=generator, dtype=torch.float64)
    found = vertex_normals(vertices, FACES)
    per_face = face_normals(vertices, FACES)
    expected = torch.stack(
        [per_face[(v == FACES).any(dim=1)].sum(dim=0) for v in range(len(vertices))]
    )
    assert_close(found, expected / expected.norm(dim=1, keepdim=True))


@pytest.mark.parametrize("unit", [1e-18, 1e12])
def test_normals_do_not_depend_on_the_unit_of_length(unit):
    vertices, faces = icosphere(3)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
        ball, scaled = vertices.to(dtype), (unit * vertices).to(dtype)
        for normals in (vertex_normals, unit_face_normals):
            assert_close(normals(scaled, faces), normals(ball, faces), rtol=0, atol=tolerance)
    flat = torch.zeros(3, 3)
    assert torch.equal(unit_face_normals(flat, torch.tensor([[0, 1, 2]])), torch.zeros(1, 3))


def test_barycentric_coordinates_rebuild_the_point_and_are_signed(generator):
    corners = torch.randn(20, 3, 2, generator=generator, dtype=torch.float64)
    points = torch.randn(20, 2, generator=generator, dtype=torch.float64)
    found = barycentric_2d(points, corners)
    assert_close(found.sum(dim=1), torch.ones(20, dtype=torch.float64))
    assert_close((found[..., None] * corners).sum(dim=1), points)
    at_corners = barycentric_2d(corners.movedim(1, 0), corners[None])
    assert_close(
        at_corners.movedim(0, 1), torch.eye(3).double().expand(20, 3, 3), atol=1e-9, rtol=0
    )
