import pytest
import torch
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.poisson import reduced
from pimper_torch.geometry.topology import boundary_vertices, half_edges
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import ConfigError


def ball(level: int = 5) -> Mesh:
    vertices, faces = icosphere(level)
    height = vertices[:, 2].float()
    return Mesh(
        vertices_world=vertices.float(),
        faces=faces,
        normals_world=vertices.float(),
        albedo=torch.stack([0.5 + 0.3 * height] * 3, dim=1),
        confidence=0.5 + 0.4 * height,
        expected_error=0.02 + 0.01 * height,
    )


@pytest.mark.parametrize("max_faces", [200, 5000])
def test_reduction_meets_max_faces_and_keeps_vertex_attributes(max_faces):
    few = reduced(ball(), max_faces)
    assert 0.9 * max_faces <= len(few.faces) <= max_faces
    assert_close(
        few.vertices_world.norm(dim=1), torch.ones(len(few.vertices_world)), atol=0.1, rtol=0
    )
    along = torch.nn.functional.normalize(few.vertices_world, dim=1)
    assert_close(few.normals_world, along, atol=0.01, rtol=0)
    assert_close(few.confidence, 0.5 + 0.4 * along[:, 2], atol=0.005, rtol=0)
    assert_close(few.expected_error, 0.02 + 0.01 * along[:, 2], atol=2e-4, rtol=0)
    assert_close(few.albedo[:, 1], 0.5 + 0.3 * along[:, 2], atol=0.005, rtol=0)
    assert few.vertices_world.dtype == torch.float32
    assert not bool(boundary_vertices(few.faces, len(few.vertices_world)).any())


def test_a_ball_far_from_the_origin_keeps_its_shape():
    mesh = ball()
    offset = torch.tensor([4.5e5, 5.4e6, 300.0]).double()
    far = mesh.replace(vertices_world=mesh.vertices_world.double() + offset)
    few = reduced(far, 500)
    radius = (few.vertices_world - offset).norm(dim=1)
    assert_close(radius, torch.ones_like(radius), atol=0.03, rtol=0)


def test_reduced_faces_are_consistently_oriented():
    few = reduced(ball(), 60)
    assert len(torch.unique(half_edges(few.faces), dim=0)) == 3 * len(few.faces)


def test_a_small_mesh_is_returned_and_fewer_than_four_faces_rejected():
    mesh = ball(1)
    assert reduced(mesh, 80) is mesh
    with pytest.raises(ConfigError, match="faces is 3; needed: 4 at least"):
        reduced(mesh, 3)


def test_no_two_faces_are_back_to_back():
    balls = [icosphere(3), *[icosphere(1)] * 4]
    places = zip((1, 0.01, 0.02, 0.03, 0.05), (0, 3, 4, 5, 6), strict=True)
    parts = [
        size * v + v.new_tensor([x, 0, 0]) for (size, x), (v, _) in zip(places, balls, strict=True)
    ]
    starts = torch.tensor([0, *[len(part) for part in parts]]).cumsum(dim=0)
    faces = [each + start for (_, each), start in zip(balls, starts, strict=False)]
    found = reduced(Mesh(vertices_world=torch.cat(parts), faces=torch.cat(faces)), 100)
    assert len(found.faces.sort(dim=1).values.unique(dim=0)) == len(found.faces)
