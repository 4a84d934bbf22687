import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.geometry.pinholes import up_world
from pimper_torch.geometry.projection import project
from pimper_torch.records import Mesh
from pimper_torch.viz import turn
from pimper_torch.viz.turn import circling, draw_turn

UP = torch.tensor([0.0, 1.0, 0.0])


@pytest.fixture
def ball():
    vertices, faces = icosphere(3)
    vertices = vertices.float()
    red, blue = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.8])
    albedo = torch.where(vertices[:, 2:] > 0, red, blue)
    return Mesh(vertices_world=vertices, faces=faces, albedo=albedo)


def test_cameras_are_upright_on_a_circle_and_show_everything(ball):
    start = torch.tensor([0.0, 3.0, 4.0])
    cameras = circling(ball, UP, start, 12, 100)
    rotations = cameras.cam_from_world[:, :3, :3]
    assert_close(rotations @ rotations.mT, torch.eye(3).expand(12, 3, 3))
    assert_close(torch.linalg.det(rotations), torch.ones(12))
    assert (rotations[:, 1] @ UP < 0).all()  # image down is world down
    centers = cameras.centers_world
    assert_close(centers[:, 1], centers[:1, 1].expand(12))
    assert centers[0, 2] > 0
    assert centers[0, 0].abs() < 1e-5  # below the start
    for view in range(12):
        pixels, depth = project(
            ball.vertices_world, cameras.cam_from_world[view], cameras.intrinsics[view]
        )
        assert depth.min() > 0
        assert 0 < pixels.min() < 8
        assert 92 < pixels.max() < 100


def test_up_is_y_unless_cameras_are_rotated(reconstruction):
    cameras = reconstruction.cameras
    quarter = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    own = -cameras.cam_from_world[:, 1, :3].mean(dim=0)
    for turned in (torch.eye(4), quarter, quarter.mT, quarter @ quarter):
        moved = cameras.replace(cam_from_world=cameras.cam_from_world @ turned.mT)
        up = up_world(moved)
        assert_close(up.norm(), torch.tensor(1.0))
        held = turned[:3, :3] @ own
        assert float(up @ held) > 0.5 * float(held.norm())
        assert torch.equal(up, UP) == bool(held[1] > 0.5 * held.norm())


def test_the_surface_turns_once_around(ball, reconstruction, tmp_path, monkeypatch):
    monkeypatch.setattr(turn, "_FRAMES", 8)
    draw_turn(ball, reconstruction.cameras, 0, tmp_path / "turn.webp")
    with Image.open(tmp_path / "turn.webp") as loop:
        assert (loop.n_frames, loop.info["loop"]) == (8, 0)
        frames = []
        for index in range(8):
            loop.seek(index)
            frames.append(np.asarray(loop.convert("RGBA")).astype(float))
    side = frames[0].shape[0]
    assert frames[0].shape == (side, 2 * side, 4)
    assert frames[0][2, 2, 3] == 0  # transparent around the object
    box = slice(side // 2 - 5, side // 2 + 5), slice(3 * side // 2 - 5, 3 * side // 2 + 5)
    middle = np.array([frame[box][..., :3].mean(axis=(0, 1)) for frame in frames])
    reds = middle[:, 0] > middle[:, 2]
    assert sum(a != b for a, b in zip(reds, np.roll(reds, 1), strict=True)) == 2  # red, then blue
    shape = frames[0][:, :side]
    assert np.ptp(shape[shape[..., 3] == 255][:, :3], axis=1).max() < 8  # grey
