import pytest
import torch
from torch.testing import assert_close

from pimper_torch.coarse.given_mesh import oriented_outward
from pimper_torch.errors import InputError
from pimper_torch.evidence.scenes.cameras import arc_cameras
from pimper_torch.evidence.scenes.meshes import icosphere
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.topology import face_components
from pimper_torch.records import Mesh
from tests.coarse.ball import all_round


def test_every_component_faces_out_however_its_faces_were_wound():
    ball, faces = icosphere(2)
    vertices = torch.cat([0.4 * ball - 0.6, 0.4 * ball + 0.6])
    both = torch.cat([faces, faces.flip(1) + len(ball)])
    generator = torch.Generator().manual_seed(2)
    mixed = torch.rand(len(both), 1, generator=generator) < 0.4
    mesh = Mesh(vertices_world=vertices, faces=torch.where(mixed, both.flip(1), both))
    found, wound = oriented_outward(mesh, all_round())
    assert int(face_components(wound).max()) == 1
    centre = torch.where((found[wound].mean(dim=1) > 0).all(dim=1, keepdim=True), 0.6, -0.6)
    outward = (face_normals(found, wound) * (found[wound].mean(dim=1) - centre)).sum(dim=1)
    assert bool((outward > 0).all())
    assert_close(found, vertices)


def test_an_open_sheet_faces_the_cameras_and_keeps_neither_slivers_nor_loose_vertices():
    vertices = torch.tensor(
        [[9.0, 9, 9], [-1, -1, 0], [1, -1, 0], [0, 1, 0], [0.5, 0, 0]], dtype=torch.float64
    )
    faces = torch.tensor([[1, 3, 2], [2, 4, 3]])  # the second on an edge of the first
    cameras = arc_cameras(3, width=60, height=40, focal_px=60.0, distance=4.0, sway_deg=0.0)
    assert bool((cameras.centers_world[:, 2] > 0).all())
    found, wound = oriented_outward(Mesh(vertices_world=vertices, faces=faces), cameras)
    assert_close(found, vertices[1:4])
    assert sorted(wound[0].tolist()) == [0, 1, 2]
    assert float(face_normals(found, wound)[0, 2]) > 0


def test_a_mesh_that_no_camera_sees_is_refused():
    vertices, faces = icosphere(0)
    with pytest.raises(InputError, match="no photograph shows"):
        oriented_outward(Mesh(vertices_world=vertices + 1e4, faces=faces), all_round())
