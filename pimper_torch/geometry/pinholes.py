"""Pinhole cameras from a viewpoint, a target and a focal length, and the up direction."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.rigid import rigid
from pimper_torch.records import Cameras
from pimper_torch.records.shapes import Poses, Vector, ViewVectors


def look_at(
    eyes_world: ViewVectors, target_world: Float[Tensor, " 3"], up_world: Float[Tensor, " 3"]
) -> Poses:
    """Return ``cam_from_world`` of upright cameras that look at one point."""
    forward = normalize(target_world - eyes_world, dim=-1)
    right = normalize(torch.linalg.cross(forward, up_world.expand_as(forward)), dim=-1)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], dim=1)
    return rigid(rotation, -(rotation @ eyes_world[..., None])[..., 0])


def pinholes(cam_from_world: Poses, focal_px: float, width: int, height: int) -> Cameras:
    """Return cameras with one focal length and the principal point in the image centre."""
    K = cam_from_world.new_tensor([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    num_views = len(cam_from_world)
    return Cameras(
        intrinsics=K.repeat(num_views, 1, 1),
        cam_from_world=cam_from_world,
        sizes_px=torch.tensor([[width, height]]).repeat(num_views, 1),
    )


def up_world(cameras: Cameras) -> Vector:
    """Return the up direction of images: y, unless the photographs contradict it.

    The frame has y up if a plane or level cameras determined it; otherwise up is the mean up
    direction of the photographs.
    """
    mean = normalize(-cameras.cam_from_world[:, 1, :3].mean(dim=0), dim=0)
    return torch.tensor([0.0, 1.0, 0.0]).to(mean) if float(mean[1]) > 0.5 else mean
