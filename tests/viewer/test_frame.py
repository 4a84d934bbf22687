import numpy as np
import pytest
import torch
from torch.testing import assert_close

from pimper_torch.geometry.rigid import transform
from pimper_torch.records import Cameras
from pimper_torch.viewer.viewer import frame_of_cameras


def cameras_on_a_ring(count, distance, height):
    """Upright cameras around the z axis that look at the origin."""
    angle = torch.linspace(0, 2 * np.pi, count + 1)[:-1].double()
    centers = torch.stack(
        [distance * angle.cos(), distance * angle.sin(), torch.full_like(angle, height)], dim=1
    )
    z = -centers / centers.norm(dim=1, keepdim=True)
    x = torch.linalg.cross(z, torch.tensor([[0.0, 0.0, 1.0]]).double().expand_as(z))
    x = x / x.norm(dim=1, keepdim=True)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z], dim=1)
    poses = torch.eye(4).double().repeat(count, 1, 1)
    poses[:, :3, :3], poses[:, :3, 3] = rotation, -(rotation @ centers[..., None])[..., 0]
    return Cameras(
        intrinsics=torch.eye(3).double().expand(count, 3, 3),
        cam_from_world=poses,
        sizes_px=torch.full((count, 2), 10),
    )


def test_the_viewers_frame_is_that_of_the_ring_of_cameras():
    """Up is the ring's axis, x points to the reference, and cameras are at distance 3."""
    frame = frame_of_cameras(cameras_on_a_ring(8, 40.0, 30.0), 2)
    rotation = frame[:3, :3] * 50 / 3
    assert_close(rotation[2], torch.tensor([0, 0, 1.0]).double(), rtol=0, atol=1e-3)
    assert_close(rotation @ rotation.mT, torch.eye(3).double(), rtol=0, atol=1e-3)
    assert float(rotation.det()) == pytest.approx(1, abs=1e-3)
    # Regularization for parallel axes moves the centre by 3e-4.
    placed = transform(frame, torch.tensor([[0.0, 40.0, 30.0], [0, 0, 0]]).double())
    wanted = torch.tensor([[2.4, 0.0, 1.8], [0, 0, 0]]).double()
    assert_close(placed, wanted, rtol=0, atol=1e-2)
