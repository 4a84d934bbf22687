"""The frame of the viewer: z up, its origin in the middle, cameras about three units away."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.rigid import invert_rigid, rigid
from pimper_torch.ground.geometry.supporting_plane import fixation
from pimper_torch.records import Cameras, Mesh


def frame_of_cameras(cameras: Cameras, reference: int) -> Float[Tensor, "4 4"]:
    """Return ``viewer_from_world``, a similarity in float64 on the CPU.

    The origin is where the cameras look, and z is up in the photographs on average.

    Args:
        reference: View that the x axis points to.
    """
    poses = cameras.cam_from_world.detach().cpu().double()
    up = normalize(-poses[:, 1, :3].mean(dim=0), dim=0)
    middle = fixation(poses)
    away = invert_rigid(poses)[reference, :3, 3] - middle.fixation_world
    x = normalize(away - (away @ up) * up, dim=0)
    scaled = 3 / middle.distance * torch.stack([x, torch.linalg.cross(up, x), up])
    return rigid(scaled, -scaled @ middle.fixation_world)


def frame_of_mesh(mesh: Mesh) -> Float[Tensor, "4 4"]:
    """Centre a mesh without cameras and keep its axes; see :func:`frame_of_cameras`."""
    low, high = mesh.vertices_world.detach().cpu().double().aminmax(dim=0)
    scaled = 3 / (high - low).norm() * torch.eye(3).double()
    return rigid(scaled, -scaled @ (low + high) / 2)
