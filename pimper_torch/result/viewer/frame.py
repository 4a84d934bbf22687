"""The frame of the viewer: z up, its origin in the middle, cameras about three units away."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.rigid import invert_rigid, rigid
from pimper_torch.ground.geometry.supporting_plane import fixation
from pimper_torch.ground.shapes import Matrix3, Scalar
from pimper_torch.records import Cameras, Mesh


def frame_of_cameras(cameras: Cameras, reference: int) -> Float[Tensor, "4 4"]:
    """Stand the scene on its feet as the photographs, taken together, show it.

    The origin is where they are directed to.

    Args:
        reference: View that the x axis points to.

    Returns:
        ``viewer_from_world``, a similarity in float64 on the CPU.
    """
    poses = cameras.cam_from_world.detach().cpu().double()
    up = normalize(-poses[:, 1, :3].mean(dim=0), dim=0)
    middle = fixation(poses)
    away = invert_rigid(poses)[reference, :3, 3] - middle.fixation_world
    x = normalize(away - (away @ up) * up, dim=0)
    rotation = torch.stack([x, torch.linalg.cross(up, x), up])
    return _similarity(rotation, middle.fixation_world, middle.distance)


def frame_of_mesh(mesh: Mesh) -> Float[Tensor, "4 4"]:
    """Centre a mesh without cameras and keep its axes; see :func:`frame_of_cameras`."""
    low, high = mesh.vertices_world.detach().cpu().double().aminmax(dim=0)
    return _similarity(torch.eye(3).double(), (low + high) / 2, (high - low).norm())


def _similarity(
    rotation: Matrix3, middle: Float[Tensor, " 3"], distance: Scalar
) -> Float[Tensor, "4 4"]:
    """Put the middle at the origin, and what is at that distance three units away."""
    scale = 3 / distance
    return rigid(scale * rotation, -scale * (rotation @ middle))
