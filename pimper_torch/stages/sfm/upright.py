"""The up direction of a model, and models turned upright.

Photographs alone do not determine it, but people hold cameras level: with EXIF's turns undone, a
camera's x axis is horizontal to a few degrees, and its y axis points down rather than up. If points
show a supporting plane, its normal is more accurate.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.rigid import invert_rigid, rigid
from pimper_torch.geometry.supporting_plane import fixation, supporting_plane
from pimper_torch.records.sparse_model import SparseModel, select_views

# Typical roll of a hand-held camera. A choice: a quarter turn counts as 1 in 900.
_ROLL = math.radians(3.0)


# Largest angle between the normal of a supporting plane and the cameras' up. A choice: a wall is 90
# degrees off, and cameras on a turntable's arc determine up to within a degree.
_WITHIN = math.cos(math.radians(30.0))


def rotate_upright(model: SparseModel) -> SparseModel:
    """Rotate a model about its origin: y up, and z towards most cameras.

    Args:
        model: Of photographs turned by EXIF.
    """
    eyes = invert_rigid(model.cam_from_world)[:, :3, 3]
    up, focus = up_direction(model), fixation(model.cam_from_world)
    front = (eyes - focus.fixation_world).mean(dim=0)
    if front.norm() < 0.1 * focus.distance:  # cameras are all around
        front = eyes[0] - focus.fixation_world
    right = torch.linalg.cross(up, front)
    if right.norm() == 0:
        right = torch.linalg.cross(up, torch.eye(3).to(up)[up.abs().argmin()])
    right = normalize(right, dim=0)
    turn = torch.stack([right, up, torch.linalg.cross(right, up)])
    world_from_turned = rigid(turn.mT, torch.zeros_like(up))
    return model.replace(
        cam_from_world=model.cam_from_world @ world_from_turned,
        points_world=model.points_world @ turn.mT,
    )


def up_direction(model: SparseModel) -> Float[Tensor, "3"]:
    """Return the unit vector that points up in a model's world.

    If the object was turned over between capture sessions, it is that of the first session.
    """
    if len(model.sessions):
        first = (model.sessions == model.sessions[0]).nonzero()[:, 0]
        model = select_views(model, first.tolist())
    up = level_up(model.cam_from_world)
    tracked = model.points_world[model.observed.sum(dim=1) >= 3]
    eyes = invert_rigid(model.cam_from_world)[:, :3, 3]
    plane = supporting_plane(tracked, eyes, float(fixation(model.cam_from_world).distance))
    supports = plane is not None and bool(plane.normal_world @ up > _WITHIN)
    return plane.normal_world if plane is not None and supports else up


def level_up(cam_from_world: Float[Tensor, "view 4 4"]) -> Float[Tensor, "3"]:
    """Return the unit vector that is up for cameras held level.

    Least squares with Cauchy's weights, as some cameras may be turned: x axes are horizontal, y
    axes point down. If all x axes are parallel, it is the negative mean of the y axes.
    """
    right, down = cam_from_world[:, 0, :3].double(), cam_from_world[:, 1, :3].double()
    up = normalize(-down.mean(dim=0), dim=0)
    for _ in range(10):
        weight = 1 / (1 + (right @ up / _ROLL) ** 2)
        across = torch.einsum("v,vi,vj->ij", weight, right, right) / _ROLL**2
        # y axes have less weight than x axes, which stay horizontal when cameras look down: at 75
        # degrees above an object, along an arc of 60, the error is 0.7 degrees; unweighted, 7.
        across = across + 0.1 * weight.sum() * torch.eye(3).to(across)
        up = -torch.linalg.solve(across, (weight[:, None] * down).sum(dim=0))
        up = normalize(up, dim=0)
    return up
