import torch
import trimesh
from torch.testing import assert_close

from pimper_torch.geometry.surfaces import component_areas
from pimper_torch.geometry.topology import (
    boundary_loops,
    boundary_vertices,
    corners_of,
    face_components,
    face_edges,
    face_pairs,
    vertex_components,
    vertex_fans,
)

# Two triangles that share the edge 0-2, and a separate third one.
FACES = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6]])


def neighbours(pairs, edges):
    return {(frozenset(pair), frozenset(edge)) for pair, edge in zip(pairs, edges, strict=True)}


def test_neighbours_agree_with_trimesh_on_a_closed_mesh():
    mesh = trimesh.creation.icosphere(subdivisions=2)
    pairs, edges = face_pairs(torch.tensor(mesh.faces))
    expected = neighbours(mesh.face_adjacency.tolist(), mesh.face_adjacency_edges.tolist())
    found = neighbours(pairs.tolist(), edges.tolist())
    assert len(pairs) == len(expected)
    assert found == expected


def test_every_edge_is_listed_once_and_is_opposite_to_its_corners():
    mesh = trimesh.creation.icosphere(subdivisions=2)
    faces = torch.from_numpy(mesh.faces)
    edges, opposite = face_edges(faces)
    assert len(torch.unique(edges, dim=0)) == len(edges)
    assert len(mesh.vertices) - len(edges) + len(faces) == 2  # Euler's formula for a sphere
    everything = torch.cat([edges[opposite], faces[:, :, None]], dim=2)
    assert (everything.sort().values == faces.sort().values[:, None]).all()


def test_boundary_edges_do_not_have_two_faces():
    hexagon = torch.tensor([[0, k, k % 6 + 1] for k in range(1, 7)])  # a fan around vertex 0
    marked = boundary_vertices(hexagon, 8)
    assert marked.tolist() == [False, *[True] * 6, False]
    closed = torch.tensor(trimesh.creation.icosphere(subdivisions=1).faces)
    assert not boundary_vertices(closed, int(closed.max()) + 1).any()
    fin = torch.cat([closed, torch.tensor([[*closed[0, :2], int(closed.max()) + 1]])])
    assert boundary_vertices(fin, int(fin.max()) + 1).nonzero()[:, 0].tolist() == sorted(
        [*closed[0, :2].tolist(), int(fin.max())]
    )


def test_corners_are_marked_once_for_chosen_faces_only():
    marked = corners_of(FACES, torch.tensor([False, True, False]), 7)
    assert marked.tolist() == [True, False, True, True, False, False, False]


def test_faces_that_share_only_a_vertex_are_not_connected():
    faces = torch.tensor([[0, 1, 2], [1, 3, 2], [3, 4, 5]])
    first, second, third = face_components(faces).tolist()
    assert first == second != third


def test_a_vertex_between_two_fans_becomes_two():
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 4, 5], [0, 5, 6]])
    source, renamed = vertex_fans(faces)
    assert source.tolist() == [0, 0, 1, 2, 3, 4, 5, 6]
    assert torch.equal(source[renamed], faces)
    assert len(renamed[:2].unique()) == 4
    assert not set(renamed[:2].flatten().tolist()) & set(renamed[2:].flatten().tolist())


def test_a_closed_fan_keeps_its_centre_and_unused_vertices_are_dropped():
    faces = torch.tensor([[9, 1, 2], [9, 2, 3], [9, 3, 1]])
    source, renamed = vertex_fans(faces)
    assert source.tolist() == [1, 2, 3, 9]
    assert torch.equal(source[renamed], faces)


def test_three_faces_at_an_edge_are_separated():
    faces = torch.tensor([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    source, renamed = vertex_fans(faces)
    assert len(source) == 9
    assert torch.equal(source[renamed], faces)


def test_vertices_are_connected_through_selected_ones_only():
    faces = torch.tensor([[0, 1, 2], [1, 3, 2], [3, 4, 5]])
    among = torch.tensor([True, False, False, True, True, False])
    label = vertex_components(faces, among).tolist()
    assert label[3] == label[4]
    assert len(set(label)) == 5


def test_boundary_loops_are_traced():
    tube = torch.tensor([[a, b, 3 + a] for a, b in ((0, 1), (1, 2), (2, 0))])
    tube = torch.cat([tube, torch.tensor([[1, 4, 3], [2, 5, 4], [0, 3, 5]])])
    ends, loop = boundary_loops(tube)
    rims = {frozenset(ends[loop == number].flatten().tolist()) for number in loop.unique()}
    assert rims == {frozenset({0, 1, 2}), frozenset({3, 4, 5})}
    assert len(ends) == 6
    capped = torch.cat([tube, torch.tensor([[0, 2, 1], [3, 4, 5]])])
    assert len(boundary_loops(capped)[0]) == 0


def test_an_edge_of_three_faces_is_a_boundary_of_each():
    ends, loop = boundary_loops(torch.tensor([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert len(ends) == 9
    assert torch.bincount(loop).tolist() == [3, 3, 3]


def test_areas_of_components_are_those_of_their_counted_faces():
    square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    vertices = torch.cat([square, 5 + 3 * square])
    faces = torch.tensor([[0, 1, 2], [4, 5, 6], [0, 2, 3], [4, 6, 7]])
    label = face_components(faces)
    wanted = torch.tensor([1.0, 9, 1, 9]).double()
    assert_close(component_areas(vertices, faces, label), wanted)
    counted = torch.tensor([True, True, False, True])
    wanted = torch.tensor([0.5, 9, 0.5, 9]).double()
    assert_close(component_areas(vertices, faces, label, counted), wanted)
