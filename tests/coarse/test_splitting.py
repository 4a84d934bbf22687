import pytest
import torch
from scenes import edge_counts
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.topology import face_edges
from pimper_torch.stages.coarse.splitting import mark_edges, split_edges


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
