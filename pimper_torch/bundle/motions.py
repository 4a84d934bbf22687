r"""Small motions of cameras, what they do to pixels, and those that all cameras share.

A camera's motion is a turn :math:`\omega` about a place :math:`m` in front of it and a shift
:math:`v`, both in its own frame, :math:`x' = e^{[\omega]} (x - m) + m + v`, and its focal length
grows by :math:`e^\varphi`. With m in the middle of the object turning hardly shifts it, so that
the seven numbers are told apart as well as can be.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.frames import rigid, transform
from pimper_torch.records import Cameras

# omega, v and phi.
MOTION = 7


def middles_cam(
    cam_from_world: Float[Tensor, "view 4 4"], middle_world: Float[Tensor, " 3"]
) -> Float[Tensor, "view 3"]:
    """Give the place that each camera turns about."""
    return transform(cam_from_world, middle_world[None])[:, 0]


def move(
    cam_from_world: Float[Tensor, "view 4 4"],
    motion: Float[Tensor, "view 6"],
    middle_world: Float[Tensor, " 3"],
) -> Float[Tensor, "view 4 4"]:
    """Turn and shift cameras."""
    turn = torch.linalg.matrix_exp(_cross_matrix(motion[:, :3]))
    middle = middles_cam(cam_from_world, middle_world)
    shift = middle + motion[:, 3:] - (turn @ middle[..., None])[..., 0]
    return rigid(turn, shift) @ cam_from_world


def motion_between(
    before: Float[Tensor, "view 4 4"],
    after: Float[Tensor, "view 4 4"],
    middle_world: Float[Tensor, " 3"],
) -> Float[Tensor, "view 6"]:
    """Undo :func:`move`: the motion that leads from one pose to the other.

    Exact in the shift; the turn is taken to be far below half a revolution.
    """
    turn = after[:, :3, :3] @ before[:, :3, :3].mT
    skew = (turn - turn.mT) / 2
    axis = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], dim=1)
    sine = axis.norm(dim=1, keepdim=True).clamp(0, 1)
    omega = torch.where(sine > 0, axis * torch.asin(sine) / torch.where(sine > 0, sine, 1), 0)
    shift = middles_cam(after, middle_world) - middles_cam(before, middle_world)
    return torch.cat([omega, shift], dim=1)


def scale_focals(
    intrinsics: Float[Tensor, "view 3 3"], growth: Float[Tensor, " view"]
) -> Float[Tensor, "view 3 3"]:
    """Multiply focal lengths by ``exp(growth)``; the principal points stay."""
    factor = torch.ones_like(intrinsics)
    factor[:, :2, :2] = growth.exp()[:, None, None]
    return intrinsics * factor


def pixel_slopes(
    points_cam: Float[Tensor, "view sample 3"],
    intrinsics: Float[Tensor, "view 3 3"],
    middle_cam: Float[Tensor, "view 3"],
) -> Float[Tensor, "view sample 2 7"]:
    """Give the derivatives of pixels by the motion of their camera, at no motion."""
    depth = points_cam[..., 2:]
    plane = points_cam[..., :2] / depth
    linear = intrinsics[:, None, :2, :2]
    straight = torch.eye(2).to(plane).expand(*plane.shape, 2)
    by_place = linear @ torch.cat([straight, -plane[..., None]], dim=-1) / depth[..., None]
    # omega x (x - m) = (m - x) x omega
    by_turn = _cross_matrix(middle_cam[:, None] - points_cam)
    return torch.cat([by_place @ by_turn, by_place, linear @ plane[..., None]], dim=-1)


def common_motions(
    cameras: Cameras, middle_world: Float[Tensor, " 3"]
) -> Float[Tensor, "view 6 7"]:
    """Give what each camera does when all move together with respect to the surface.

    The columns are turns about and shifts along the world's axes, and a growth of the distance:
    the seven of a similarity, which no relation between views alone can tell.
    """
    rotation = cameras.cam_from_world[:, :3, :3]
    middle = middles_cam(cameras.cam_from_world, middle_world)
    found = rotation.new_zeros(len(rotation), 6, 7)
    found[:, :3, :3] = rotation
    found[:, 3:, 3:6] = rotation
    found[:, 3:, 6] = middle
    return found


def lens_groups(lenses: Int[Tensor, " view"]) -> Int[Tensor, " view"]:
    """Number the lenses from 0, in the order of their own numbers."""
    return torch.unique(lenses, return_inverse=True)[1]


def _cross_matrix(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Give the matrices that take the cross product with these from the left."""
    x, y, z = vectors.unbind(dim=-1)
    none = torch.zeros_like(x)
    rows = [none, -z, y, z, none, -x, -y, x, none]
    return torch.stack(rows, dim=-1).reshape(*vectors.shape, 3)
