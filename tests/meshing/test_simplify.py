import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere, table
from pimper_torch.geometry.nearest import NearestSurface, closest_on_triangles
from pimper_torch.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.records import Mesh
from pimper_torch.stages.meshing.simplify import simplify
from tests.threads import on_threads


def square(side, height):
    """A height field over the unit square, with random values at its vertices."""
    generator = torch.Generator().manual_seed(3)
    flat = table(0.5, cells=side - 1)
    x, y = (flat.vertices_world[:, :2] + 0.5).unbind(dim=1)
    vertices, faces = torch.stack([x, y, height(x, y)], dim=1), flat.faces
    return Mesh(
        vertices_world=vertices,
        faces=faces,
        normals_world=normalize(vertex_normals(vertices, faces), dim=1),
        albedo=0.5 + 0.4 * torch.sin(12 * vertices),
        confidence=torch.rand(len(vertices), generator=generator, dtype=torch.float64),
    )


def waves(x, y):
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(4), dtype=x.dtype)
    return 0.1 * torch.sin(7 * x) * torch.cos(5 * y) + 2e-4 * noise


def deviations(mesh, found, values):
    """Return distance, angle and largest channel difference of removed vertices and their faces."""
    gone = (found.face >= 0).nonzero()[:, 0]
    corners = found.mesh.faces[found.face[gone]]
    place = closest_on_triangles(mesh.vertices_world[gone], found.mesh.vertices_world[corners])
    triangles = found.mesh.vertices_world[corners]
    blend = torch.linalg.lstsq(triangles.mT, place[..., None]).solution
    normals = normalize((blend * found.mesh.normals_world[corners]).sum(dim=1), dim=1)
    cosine = (normals * mesh.normals_world[gone]).sum(dim=1)
    off = (blend * values[found.kept][corners]).sum(dim=1) - values[gone]
    return (
        (place - mesh.vertices_world[gone]).norm(dim=1),
        cosine.clamp(-1, 1).acos().rad2deg(),
        off.abs(),
    )


def test_removed_vertices_are_within_the_bounds():
    mesh = square(60, waves)
    mesh = mesh.replace(vertices_world=mesh.vertices_world + torch.tensor([3.0, -4.0, 5.0]))
    values = 10 * mesh.albedo
    found = simplify(mesh, values, spacings=0.1, angle_deg=3.0)
    assert len(found.kept) < 0.5 * len(mesh.vertices_world)
    assert len(found.kept) + int((found.face >= 0).sum()) == len(mesh.vertices_world)
    distance, angle, off = deviations(mesh, found, values)
    # Positions in the kernel are float32.
    assert distance.max() <= 0.1 * found.spacing * (1 + 1e-3)
    assert angle.max() <= 3.0 + 1e-2
    assert off.max() <= 1 + 1e-3
    assert found.max_spacings == pytest.approx(float(distance.max()) / found.spacing, rel=1e-2)
    assert found.max_angle_deg == pytest.approx(float(angle.max()), rel=1e-2)
    nearest = NearestSurface(found.mesh).query(mesh.vertices_world).distance
    assert nearest.max() <= 0.1 * found.spacing * (1 + 1e-3)


@pytest.mark.parametrize(
    ("spacings", "angle_deg", "channel"),
    [(0.001, 180.0, None), (100.0, 0.05, None), (100.0, 180.0, 1e3)],
)
def test_each_bound_alone_keeps_vertices(spacings, angle_deg, channel):
    mesh = square(40, waves)
    values = None if channel is None else channel * mesh.albedo
    loose = simplify(mesh, spacings=100.0, angle_deg=180.0)
    found = simplify(mesh, values, spacings=spacings, angle_deg=angle_deg)
    assert len(found.kept) > 0.9 * len(mesh.vertices_world) > 5 * len(loose.kept)


def test_kept_vertices_are_unchanged():
    mesh = square(40, waves)
    found = simplify(mesh)
    for name in ("vertices_world", "normals_world", "albedo", "confidence"):
        assert torch.equal(getattr(found.mesh, name), getattr(mesh, name)[found.kept])
    border = ((mesh.vertices_world[:, :2] == 0) | (mesh.vertices_world[:, :2] == 1)).any(dim=1)
    assert torch.isin(border.nonzero()[:, 0], found.kept).all()
    assert found.mesh.expected_error is None


def test_a_plane_keeps_little_more_than_its_border():
    mesh = square(40, lambda x, _: 0.0 * x)
    found = simplify(mesh)
    assert len(found.kept) < 4 * 39 + 40
    area = face_normals(found.mesh.vertices_world, found.mesh.faces)
    assert (area[:, 2] > 0).all()  # no face is flipped
    assert_close(area[:, 2].sum() / 2, torch.tensor(1.0, dtype=torch.float64))


def test_a_closed_surface_stays_closed_and_oriented():
    vertices, faces = icosphere(5)
    vertices = vertices.double()
    found = simplify(Mesh(vertices_world=vertices, faces=faces)).mesh
    count = len(found.vertices_world)
    assert count < len(vertices) / 4
    edges = torch.cat([found.faces[:, [0, 1]], found.faces[:, [1, 2]], found.faces[:, [2, 0]]])
    assert len(torch.unique(edges, dim=0)) == len(edges)  # each once per direction
    assert set(map(tuple, edges.tolist())) == set(map(tuple, edges.flip(1).tolist()))
    assert count - len(edges) // 2 + len(found.faces) == 2
    volume = torch.linalg.det(found.vertices_world[found.faces]).sum() / 6
    assert 0.97 * 4.18879 < volume < 4.18879


def test_the_result_does_not_depend_on_the_number_of_threads():
    mesh = square(50, waves)
    assert torch.equal(*on_threads(lambda: simplify(mesh).mesh.faces, 1, 3))


def test_values_of_kept_vertices_have_gradients():
    mesh = square(20, waves)
    vertices = mesh.vertices_world.clone().requires_grad_()
    found = simplify(mesh.replace(vertices_world=vertices))
    found.mesh.vertices_world.sum().backward()
    assert set(vertices.grad.sum(dim=1).tolist()) == {0.0, 3.0}


def test_meshes_that_cannot_be_simplified_are_unchanged():
    corners = torch.eye(4, 3, dtype=torch.float64)
    tetrahedron = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    crowded = torch.cat([tetrahedron[:1], tetrahedron[:1], tetrahedron[:1]])  # not a manifold
    for faces in (tetrahedron, crowded):
        mesh = Mesh(vertices_world=corners, faces=faces)
        found = simplify(mesh, spacings=100.0, angle_deg=180.0)
        assert torch.equal(found.mesh.faces, faces)
    cloud = Mesh(vertices_world=corners, faces=torch.zeros(0, 3, dtype=torch.long))
    assert simplify(cloud).mesh is cloud
