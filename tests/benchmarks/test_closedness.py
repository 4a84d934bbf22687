import math

import pytest
import torch
import trimesh
from closedness import closedness
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import InputError


def mesh_of(vertices, faces):
    return Mesh(vertices_world=torch.as_tensor(vertices).double(), faces=torch.as_tensor(faces))


def without(mesh, corner):
    """Return the mesh without the faces around a vertex."""
    return mesh.replace(faces=mesh.faces[(mesh.faces != corner).all(dim=1)])


@pytest.fixture
def sphere():
    return Mesh(**dict(zip(("vertices_world", "faces"), icosphere(3), strict=True)))


def test_a_sphere_is_closed_and_smooth(sphere):
    found = closedness(sphere)
    assert found.closed
    assert found.border_percent == 0
    assert (found.pieces, found.euler, found.handles, found.folds) == (1, 2, 0, 0)
    assert_close(found.diagonal, 2 * math.sqrt(3))


def test_every_opening_is_one_loop_with_its_length(sphere):
    found = closedness(without(without(sphere, 0), 100))  # one of five corners, one of six
    assert not found.closed
    assert found.edges.tolist() == [6, 5]
    ring = sphere.faces[(sphere.faces == 100).any(dim=1)]
    length = (
        trimesh.Trimesh(sphere.vertices_world.numpy(), ring.numpy(), process=False).outline().length
    )
    assert_close(float(found.loops[0]), float(length))
    assert_close(found.border_percent, 100 * float(found.loops.sum()) / (2 * math.sqrt(3)))
    assert (found.euler, found.handles) == (0, 0)


def test_openings_that_share_a_vertex_count_as_one(sphere):
    """The surface is not connected at that vertex."""
    around = sphere.faces[(sphere.faces == 100).any(dim=1)].unique()
    for other in range(len(sphere.vertices_world)):
        its = sphere.faces[(sphere.faces == other).any(dim=1)].unique()
        if int(torch.isin(its, around).sum()) == 1:
            break
    found = closedness(without(without(sphere, 100), other))
    assert found.edges.tolist() == [6 + len(its) - 1]


def test_a_torus_has_a_handle():
    torus = trimesh.creation.torus(1.0, 0.4)
    found = closedness(mesh_of(torus.vertices.copy(), torus.faces.copy()))
    assert found.closed
    assert (found.euler, found.handles) == (0, 1)


def test_a_box_has_twelve_right_angled_edges():
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    mesh = mesh_of(box.vertices.copy(), box.faces.copy())
    assert closedness(mesh, fold_deg=89.0).folds == 12
    assert closedness(mesh, fold_deg=91.0).folds == 0


def test_non_manifold_and_inconsistent_edges_are_reported():
    corners = torch.eye(5)[:, :3] + torch.arange(5)[:, None] * 0.1
    fan = closedness(mesh_of(corners, [[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert (fan.crowded, fan.twisted, fan.closed) == (1, 0, False)
    pair = closedness(mesh_of(corners, [[0, 1, 2], [0, 1, 3]]))
    assert (pair.crowded, pair.twisted) == (0, 1)
    assert closedness(mesh_of(corners, [[0, 1, 2], [1, 0, 3]])).twisted == 0
    ball = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
    assert closedness(mesh_of(corners, ball)).closed
    ball[3] = [1, 2, 3]
    rotated = closedness(mesh_of(corners, ball))
    assert (rotated.twisted, rotated.closed, len(rotated.loops)) == (3, False, 0)


def test_a_cloud_is_refused():
    with pytest.raises(InputError, match="3 vertices without faces"):
        closedness(mesh_of(torch.eye(3), torch.zeros(0, 3, dtype=torch.long)))
