import pytest
import torch
from scenes import CORNERS, FACETS, edge_counts
from surfaces import surface_of
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.surfaces import barycentric_2d, face_normals, vertex_normals
from pimper_torch.geometry.topology import face_edges
from pimper_torch.records import Mesh
from pimper_torch.stages.coarse.splitting import fitted_normals, mark_edges, split_edges


def areas(vertices, faces):
    return face_normals(vertices, faces).norm(dim=1) / 2


def smallest_angle(vertices, faces):
    corners = vertices[faces]
    ahead = corners.roll(-1, dims=1) - corners
    back = corners.roll(1, dims=1) - corners
    cosine = (ahead * back).sum(-1) / ahead.norm(dim=-1) / back.norm(dim=-1)
    return torch.rad2deg(cosine.clamp(-1, 1).acos()).min()


def halved(vertices, faces, marked):
    split = split_edges(vertices, faces, marked)
    edges, _ = face_edges(faces)
    return split, torch.cat([vertices, vertices[edges[split.halved]].mean(dim=1)])


@pytest.mark.parametrize("fraction", [0.1, 1.0])
def test_splitting_keeps_a_closed_mesh_closed_with_its_area_and_volume(generator, fraction):
    vertices, faces = icosphere(2)
    edges, _ = face_edges(faces)
    marked = torch.rand(len(edges), generator=generator) < fraction
    split, places = halved(vertices, faces, marked)
    assert (edge_counts(split.faces)[1] == 2).all()
    assert len(split.faces) == len(faces) + 2 * int(marked.sum())
    assert len(places) == len(vertices) + int(marked.sum())
    ours, theirs = face_normals(places, split.faces), face_normals(vertices, faces)
    assert_close(torch.zeros_like(theirs).index_add(0, split.parent, ours), theirs)
    assert ((ours * theirs[split.parent]).sum(dim=1) > 0).all()  # none is flipped or degenerate
    volume = (places[split.faces].det() / 6).sum()
    assert_close(volume, (vertices[faces].det() / 6).sum())


def test_children_have_barycentric_coordinates_in_their_parents(generator):
    vertices, faces = icosphere(1)
    marked = torch.rand(len(face_edges(faces)[0]), generator=generator) < 0.5
    split, places = halved(vertices, faces, marked)
    expected = split.corners @ vertices[faces[split.parent]]
    assert_close(places[split.faces], expected)


def test_points_are_located_in_the_child_that_contains_them(generator):
    vertices, faces = icosphere(1)
    marked = torch.rand(len(face_edges(faces)[0]), generator=generator) < 0.5
    split, places = halved(vertices, faces, marked)
    face = torch.randint(len(faces), (500,), generator=generator)
    inside = torch.distributions.Dirichlet(torch.ones(3).double()).sample((500,))
    child, there = split.relocate(face, inside)
    assert (split.parent[child] == face).all()
    assert (there > -1e-9).all()
    before = (inside[:, :, None] * vertices[faces[face]]).sum(dim=1)
    after = (there[:, :, None] * places[split.faces[child]]).sum(dim=1)
    assert_close(after, before)


def test_repeated_splits_of_a_corner_bound_angles_from_below():
    vertices = torch.tensor([[0.0, 0], [4, 0], [1, 2], [5, 2.5]], dtype=torch.float64)
    vertices = torch.cat([vertices, torch.zeros(4, 1).double()], dim=1)
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]])
    first = smallest_angle(vertices, faces)
    for _ in range(8):
        at_corner = (faces == 0).any(dim=1)
        marked = mark_edges(vertices, faces, at_corner, torch.zeros_like(at_corner))
        split, vertices = halved(vertices, faces, marked)
        faces = split.faces
    assert smallest_angle(vertices, faces) > first / 2 - 1e-9
    assert areas(vertices, faces).min() < 1e-3 * areas(vertices, faces).max()  # graded


def test_forbidden_faces_keep_their_edges():
    vertices, faces = icosphere(1)
    wanted = torch.zeros(len(faces), dtype=torch.bool)
    wanted[:10] = True
    forbidden = ~wanted
    marked = mark_edges(vertices, faces, wanted, forbidden)
    split = split_edges(vertices, faces, marked)
    counts = torch.bincount(split.parent, minlength=len(faces))
    assert (counts[forbidden] == 1).all()
    assert (counts[wanted] > 1).any()
    assert (edge_counts(split.faces)[1] == 2).all()


def square():
    """Return two facets, and their subdivision with halved edges."""
    edges, _ = face_edges(FACETS)
    split = split_edges(CORNERS, FACETS, torch.ones(len(edges), dtype=torch.bool))
    fine = torch.cat([CORNERS, CORNERS[edges[split.halved]].mean(dim=1)])
    return CORNERS, FACETS, split, fine


def on_facets(vertices, faces, count, generator, normal):
    """Return a surface of points on facets, with normals as a function of position."""
    facet = torch.randint(len(faces), (count,), generator=generator)
    barycentric = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    barycentric = barycentric / barycentric.sum(dim=1, keepdim=True)
    points = (barycentric[:, None] @ vertices[faces[facet]])[:, 0]
    return surface_of(
        points,
        torch.zeros(0, 3, dtype=torch.long),
        facet=facet,
        barycentric=barycentric,
        normals_world=normal(points),
        information=100 * torch.rand(count, generator=generator, dtype=torch.float64),
    )


def test_inherited_normals_are_a_weighted_least_squares_fit(generator):
    vertices, faces, split, fine = square()

    def bent(points):
        noise = 0.2 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
        return normalize(points.new_tensor([0, 0, 1]) + 0.5 * points.sin() + noise, dim=1)

    surface = on_facets(vertices, faces, 500, generator, bent)
    index = torch.arange(len(split.faces))
    mesh = Mesh(vertices_world=fine, faces=split.faces)
    found = fitted_normals(mesh, surface, split, index)
    # A dense solve; coordinates of each point in the children, in the plane of the square.
    flat = fine[split.faces][..., :2]
    inside = barycentric_2d(surface.vertices_world[:, None, :2], flat[None])
    child = inside.amin(dim=-1).argmax(dim=1)
    blend = torch.zeros(len(child), len(fine), dtype=torch.float64)
    weights = inside[torch.arange(len(child)), child]
    blend.scatter_(1, split.faces[child], weights)
    own = vertex_normals(fine, split.faces)
    weight = (surface.confidence + 0.05)[:, None]  # confidence plus a twentieth
    matrix = blend.mT @ (weight * blend)
    damping = 0.01 * matrix.diagonal().mean()  # weight of the facets' own normals
    damped = matrix + damping * torch.eye(len(fine)).double()
    right = blend.mT @ (weight * surface.normals_world) + damping * own
    assert_close(found, normalize(torch.linalg.solve(damped, right), dim=1))
    assert float(torch.rad2deg((found * own).sum(dim=1).clamp(-1, 1).acos()).max()) > 10


def test_facets_without_surface_vertices_keep_their_own_normals(generator):
    vertices, faces, split, fine = square()
    lean = torch.tensor([0.6, 0, 0.8]).double()
    surface = on_facets(vertices, faces, 500, generator, lambda points: lean.expand_as(points))
    kept = split.parent == 0
    index = torch.where(kept, kept.cumsum(dim=0) - 1, -1)
    surface = surface.take(surface.facet == 1)  # only on the dropped facet
    mesh = Mesh(vertices_world=fine, faces=split.faces[kept])
    found = fitted_normals(mesh, surface, split, index)
    used = torch.unique(mesh.faces)
    assert_close(found[used], torch.tensor([0.0, 0, 1]).double().expand(len(used), 3))
