import math

import torch
import trimesh

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.topology import face_edges
from pimper_torch.stages.meshing import borders
from tests.meshing.sheets import sheet_of

LENGTH = 3.0


def protruding(vertices, faces, length, unsure=None):
    """Mark protruding faces; by default no face is determined."""
    unsure = torch.ones(len(faces), dtype=torch.bool) if unsure is None else unsure
    return borders.protruding(vertices, faces, length, unsure, face_edges(faces))


def sheet(side=61):
    """Return vertices, faces and face centres of a slightly bent square sheet of unit spacing."""
    vertices, faces = sheet_of(side, 0.003)
    return vertices, faces, vertices[faces].mean(dim=1)[:, :2]


def test_straight_borders_are_kept_and_right_angles_rounded():
    vertices, faces, middle = sheet()
    found = protruding(vertices, faces, LENGTH)
    corner = torch.tensor([[0.0, 0.0], [0.0, 60.0], [60.0, 0.0], [60.0, 60.0]]).double()
    away = torch.cdist(middle, corner).amin(dim=1)
    assert found[away < LENGTH].all()
    assert not found[away > 3.5 * LENGTH].any()


def test_a_round_border_of_a_few_lengths_is_kept():
    vertices, faces, middle = sheet()
    disc = (middle - 30).norm(dim=1) < 6.0 * LENGTH
    found = protruding(vertices, faces[disc], LENGTH)
    assert not found[(middle[disc] - 30).norm(dim=1) < 6.0 * LENGTH - 2].any()


def test_teeth_are_cut_off_and_notches_kept():
    vertices, faces, middle = sheet()
    x, y = middle.unbind(dim=1)
    height = 5 * (1 - ((y / 3) % 2 - 1).abs())  # teeth 6 wide and 5 high
    kept = x < 30 + height
    found = protruding(vertices, faces[kept], LENGTH)
    x, y = x[kept], y[kept]
    inside = (y > 14) & (y < 46)
    assert found[inside & (x > 34)].all()
    assert not found[inside & (x > 12) & (x < 29)].any()


def test_narrow_flaps_are_removed():
    vertices, faces, middle = sheet()
    x, y = middle.unbind(dim=1)
    body, flap = x < 30, (y - 30).abs() < 0.7 * LENGTH
    kept = body | flap
    found = protruding(vertices, faces[kept], LENGTH)
    assert found[x[kept] > 30 + LENGTH].all()
    inside = (x > 8) & (x < 28) & (y > 8) & (y < 52)
    assert not found[inside[kept]].any()


def test_determined_faces_and_those_they_support_are_kept():
    vertices, faces, middle = sheet()
    x, y = middle.unbind(dim=1)
    kept = (x < 30) | ((y - 30).abs() < 0.7 * LENGTH)
    unsure = (x > 40)[kept]
    found = protruding(vertices, faces[kept], LENGTH, unsure)
    assert not found[~unsure].any()
    assert found[(x > 44)[kept]].all()
    assert not protruding(vertices, faces[kept], LENGTH, torch.zeros_like(unsure)).any()


def test_small_holes_and_closed_surfaces_have_no_protrusions():
    vertices, faces, middle = sheet()
    round_hole = (middle - 30).norm(dim=1) < 0.9 * LENGTH
    kept = faces[~round_hole]
    near = ((middle - 30).norm(dim=1) < 15)[~round_hole]
    assert not protruding(vertices, kept, LENGTH)[near].any()
    ball, closed = icosphere(3)
    assert not protruding(ball, closed, 0.2).any()


def test_protrusions_are_invariant_to_similarities():
    vertices, faces, middle = sheet()
    kept = faces[(middle[:, 0] < 30) | ((middle[:, 1] - 30).abs() < 2)]
    turn = torch.tensor(trimesh.transformations.rotation_matrix(math.pi / 5, [1, 2, 3])[:3, :3])
    moved = 0.01 * vertices @ turn.T + 7
    assert torch.equal(protruding(vertices, kept, LENGTH), protruding(moved, kept, 0.01 * LENGTH))
