import numpy as np
import pytest
import torch

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.records import Cameras, Mesh
from pimper_torch.result.viewer.frame import frame_of_cameras, frame_of_mesh, stand_of
from pimper_torch.result.viewer.layers import LAYERS, painted


@pytest.fixture
def ball():
    """A sphere that carries all that a result does."""
    vertices, faces = icosphere(2)
    vertices = vertices.float()
    return Mesh(
        vertices_world=vertices,
        faces=faces,
        normals_world=vertices,
        albedo=0.5 + 0.4 * vertices,
    )


@pytest.mark.parametrize("name", LAYERS)
def test_every_layer_gives_colours(ball, name):
    layer = painted(ball, name, frame_of_mesh(ball))
    assert layer.colors.shape == ball.vertices_world.shape
    assert 0 <= float(layer.colors.min()) <= float(layer.colors.max()) <= 1 + 1e-6
    assert layer.lit == (name in ("lit", "shape"))


def test_the_shape_is_shaded_by_its_own_normals(ball):
    lying = ball.replace(normals_world=-ball.normals_world)
    layer = painted(lying, "shape", frame_of_mesh(ball))
    assert ((layer.normals_world * ball.vertices_world).sum(dim=1) > 0.99).all()


def cameras_on_a_ring(count, distance, height):
    """Upright cameras round the z axis that look at the origin."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        center = np.array([distance * np.cos(angle), distance * np.sin(angle), height])
        z = -center / np.linalg.norm(center)
        x = np.cross(z, [0, 0, 1])
        x /= np.linalg.norm(x)
        rotation = np.stack([x, np.cross(z, x), z])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
        poses.append(pose)
    return Cameras(
        intrinsics=torch.eye(3).double().expand(count, 3, 3),
        cam_from_world=torch.tensor(np.stack(poses)),
        sizes_px=torch.full((count, 2), 10),
    )


@pytest.mark.parametrize("known", [True, False])
def test_the_viewer_stands_on_the_ring_of_cameras(known):
    """Up is the ring's axis, x points to the reference, and cameras are three away."""
    cameras = cameras_on_a_ring(8, 40.0, 30.0)
    points = torch.zeros(1 if known else 0, 3)
    frame = frame_of_cameras(cameras, 2, points)
    torch.testing.assert_close(frame.rotation[2], torch.tensor([0, 0, 1.0]).double())
    torch.testing.assert_close(frame.rotation @ frame.rotation.mT, torch.eye(3).double())
    assert float(frame.rotation.det()) == pytest.approx(1)
    placed = frame.points(torch.tensor([[0.0, 40.0, 30.0]]))
    # Without points the middle is pulled by 3e-4 to where parallel axes would have it.
    wanted = torch.tensor([[2.4, 0.0, 1.8]]).double()
    torch.testing.assert_close(placed, wanted, rtol=0, atol=1e-6 if known else 1e-2)


def test_a_stand_looks_along_the_camera_and_rolls_with_it():
    cameras = cameras_on_a_ring(8, 40.0, 30.0)
    quarter = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]).double()
    cameras = cameras.replace(
        cam_from_world=torch.cat([cameras.cam_from_world[:7], quarter @ cameras.cam_from_world[7:]])
    )
    frame = frame_of_cameras(cameras_on_a_ring(8, 40.0, 30.0), 0, torch.zeros(1, 3))
    upright, lying = stand_of(cameras, 0, frame), stand_of(cameras, 7, frame)
    torch.testing.assert_close(upright.position.norm(), torch.tensor(3.0).double())
    torch.testing.assert_close(upright.ahead, torch.zeros(3).double(), atol=1e-9, rtol=0)
    torch.testing.assert_close(upright.up, torch.tensor([0, 0, 1.0]).double())
    assert upright.fov == pytest.approx(2 * np.arctan(5))
    assert abs(float(lying.up @ lying.rotation[:, 0])) < 1e-9  # right in its picture is right


def test_normals_are_coloured_as_the_reference_camera_sees_them(ball):
    """Blue towards it, red to its right, green up."""
    cameras = cameras_on_a_ring(8, 40.0, 0.0)
    frame = frame_of_cameras(cameras, 0, torch.zeros(1, 3))
    normals = torch.eye(3)
    three = Mesh(vertices_world=normals, faces=torch.tensor([[0, 1, 2]]), normals_world=normals)
    colors = painted(three, "normals", frame).colors
    assert colors.argmax(dim=1).tolist() == [2, 0, 1]
