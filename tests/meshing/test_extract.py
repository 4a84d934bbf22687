import pytest
import torch
import trimesh
from surfaces import surface_of
from torch.testing import assert_close

from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.stages.meshing.extract import Extract
from pimper_torch.stages.meshing.faults import bounding_diagonal
from pimper_torch.stages.meshing.meshing_config import ExtractConfig
from tests.meshing.sheets import sheet_of

SIDE = 21


def sheet(side=SIDE, information=None):
    """Return a slightly bent square sheet of unit spacing, seen from -z; one facet per vertex."""
    vertices, faces = sheet_of(side, 0.01)
    x = vertices[:, 0]
    normals = torch.stack([0.02 * x, 0 * x, -torch.ones_like(x)], dim=1)
    return surface_of(
        vertices,
        faces,
        facet=torch.arange(len(x)),
        normals_world=torch.nn.functional.normalize(normals, dim=-1),
        albedo=vertices / side,
        information=torch.ones_like(x) if information is None else information,
    )


def columns(surface):
    return surface.vertices_world[:, 0]


def as_trimesh(mesh):
    return trimesh.Trimesh(mesh.vertices_world.numpy(), mesh.faces.numpy(), process=False)


def test_a_fully_supported_surface_is_unchanged():
    surface = sheet()
    mesh = Extract()(surface)
    assert_close(mesh.vertices_world, surface.vertices_world)
    assert torch.equal(mesh.faces, surface.faces)
    assert_close(mesh.normals_world, surface.normals_world)
    assert_close(mesh.albedo, surface.albedo)
    assert_close(mesh.confidence, surface.confidence)


def test_swept_heights_support_a_surface_without_photometric_normals():
    surface = sheet()
    left = columns(surface) <= 5
    heights = torch.where(left, 0, 1.0).double()
    surface = surface.replace(information=heights * 0, height_information=heights)
    mesh = Extract(ExtractConfig(max_hole=0.0))(surface)
    assert columns(mesh).min() == 6
    assert (mesh.confidence == 0).all()


def test_small_holes_are_filled_and_large_ones_kept():
    surface = sheet()
    x, y = columns(surface), surface.vertices_world[:, 1]
    small = (x - 4).abs().maximum((y - 4).abs()) <= 1
    large = (x - 13).abs().maximum((y - 13).abs()) <= 4
    information = (~(small | large)).double()
    mesh = Extract(ExtractConfig(max_hole=0.2))(surface.replace(information=information))
    assert (mesh.confidence == 0).sum() == 9
    assert len(mesh.vertices_world) == SIDE**2 - 81
    assert as_trimesh(mesh).euler_number == 0  # a disc with one hole
    closed = Extract(ExtractConfig(max_hole=0.5))(surface.replace(information=information))
    assert as_trimesh(closed).euler_number == 1


def test_islands_are_removed():
    surface = sheet(information=((columns(sheet()) < 6) | (columns(sheet()) > 9)).double())
    mesh = Extract(ExtractConfig(max_hole=0.1, min_piece=1.0))(surface)
    assert columns(mesh).min() == 10
    assert len(as_trimesh(mesh).split(only_watertight=False)) == 1
    both = Extract(ExtractConfig(max_hole=0.1, min_piece=0.0))(surface)
    assert columns(both).min() == 0
    assert len(as_trimesh(both).split(only_watertight=False)) == 2


def test_components_that_touch_in_a_vertex_are_separated():
    surface = sheet()
    x, y = columns(surface), surface.vertices_world[:, 1]
    hourglass = ((x <= 10) & (y >= 10)) | ((x >= 10) & (y <= 10))
    touching = surface.replace(information=hourglass.double())
    mesh = Extract(ExtractConfig(max_hole=0.1, min_piece=0.0))(touching)
    # Diagonals have the other direction, so that no face bridges the two squares.
    waist = (mesh.vertices_world[:, :2] == 10).all(dim=1)
    assert waist.sum() == 2
    largest = Extract(ExtractConfig(max_hole=0.1, min_piece=1.0))(touching)
    assert len(largest.vertices_world) == 121


def test_spikes_and_flipped_faces_are_removed():
    surface = sheet()
    vertices = surface.vertices_world.clone()
    spike, folded = 5 * SIDE + 15, 15 * SIDE + 5
    vertices[spike, 2] = -30
    vertices[folded, 0] += 2.5  # over its neighbours: some faces are averted
    bent = surface.replace(vertices_world=vertices)
    mesh = Extract()(bent)
    assert mesh.vertices_world[:, 2].min() > -1
    assert len(mesh.vertices_world) == SIDE**2 - 1  # the folded vertex keeps its good faces
    gone = len(surface.faces) - len(mesh.faces)
    assert 6 < gone <= 12


def test_vertices_carry_gradients():
    surface = sheet()
    vertices = surface.vertices_world.clone().requires_grad_()
    information = (columns(surface) < 15).double()
    mesh = Extract(ExtractConfig(max_hole=0.1))(
        surface.replace(vertices_world=vertices, information=information)
    )
    mesh.vertices_world.sum().backward()
    kept = (columns(surface) < 15).double()[:, None].expand(-1, 3)
    assert_close(vertices.grad, kept)


def test_normals_are_unit_and_faces_outward():
    surface = sheet()
    mesh = Extract()(surface.replace(normals_world=1.01 * surface.normals_world))
    assert_close(mesh.normals_world.norm(dim=-1), torch.ones(SIDE**2).double())
    own = torch.tensor(as_trimesh(mesh).face_normals)
    assert ((mesh.normals_world[mesh.faces[:, 0]] * own).sum(-1) > 0).all()


def test_a_surface_without_confidence_is_kept_entirely():
    surface = sheet(information=torch.zeros(SIDE**2).double())
    assert len(Extract()(surface).faces) == len(surface.faces)


def test_a_surface_without_enough_support_is_rejected():
    information = torch.zeros(SIDE**2).double()
    information[0] = 0.1  # a single vertex
    with pytest.raises(ReconstructionError, match="0 of 800 faces have support"):
        Extract(ExtractConfig(max_hole=0.2))(sheet(information=information))


def test_faces_with_a_large_expected_error_are_removed():
    surface = sheet()
    fraction = columns(surface) / (SIDE - 1) / 10
    inexact = surface.replace(expected_error=fraction * bounding_diagonal(surface.vertices_world))
    mesh = Extract(ExtractConfig(max_expected_error=0.05))(inexact)
    assert columns(mesh).max() == (SIDE - 1) / 2
    assert len(mesh.faces) == len(surface.faces) // 2
    kept = mesh.vertices_world[:, 0] / (SIDE - 1) / 10 * bounding_diagonal(surface.vertices_world)
    assert_close(mesh.expected_error, kept)  # each belongs to its vertex
    assert len(Extract(ExtractConfig(max_expected_error=0.11))(inexact).faces) == len(surface.faces)
    vague = surface.replace(expected_error=1 + 0 * fraction)
    with pytest.raises(ReconstructionError, match="max_expected_error"):
        Extract(ExtractConfig(max_expected_error=1e-9))(vague)
