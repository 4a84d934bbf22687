"""Where the photographer of a rendered scene stands."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.frames import rigid
from pimper_torch.records import Cameras


def look_at(
    eyes_world: Float[Tensor, "view 3"],
    target_world: Float[Tensor, " 3"],
    up_world: Float[Tensor, " 3"],
) -> Float[Tensor, "view 4 4"]:
    """Give ``cam_from_world`` of cameras that look at one point and are held upright."""
    forward = normalize(target_world - eyes_world, dim=-1)
    right = normalize(torch.linalg.cross(forward, up_world.expand_as(forward)), dim=-1)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], dim=1)
    return rigid(rotation, -(rotation @ eyes_world[..., None])[..., 0])


def pinholes(
    cam_from_world: Float[Tensor, "view 4 4"], focal_px: float, width: int, height: int
) -> Cameras:
    """Give cameras of one focal length whose axis meets the middle of the image."""
    K = cam_from_world.new_tensor([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    num_views = len(cam_from_world)
    return Cameras(
        intrinsics=K.repeat(num_views, 1, 1),
        cam_from_world=cam_from_world,
        sizes_px=torch.tensor([[width, height]]).repeat(num_views, 1),
    )


def arc_cameras(
    num_views: int,
    *,
    width: int,
    height: int,
    focal_px: float,
    distance: float,
    span_deg: float = 50.0,
    elevation_deg: float = 0.0,
    sway_deg: float = 4.0,
    target: tuple[float, float, float] = (0.0, 0.0, 0.0),
    front: tuple[float, float, float] = (0.0, 0.0, 1.0),
    up: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> Cameras:
    """Walk round a target on an arc, looking at it; float64.

    The defaults face the flat shapes of :mod:`pimper_torch.scenes.shapes` from above.

    Args:
        num_views: How many photographs.
        width: Pixels.
        height: Pixels.
        focal_px: Pixels.
        distance: From the target, scene units.
        span_deg: From the first camera to the last, about ``up``.
        elevation_deg: Mean height of the arc over the plane across ``up``.
        sway_deg: How far the elevation goes up and down on the way.
        target: What the cameras look at.
        front: Towards the middle of the arc; must be across ``up``.
        up: Axis of the arc, and up in the photographs.
    """
    along = torch.linspace(-0.5, 0.5, num_views, dtype=torch.float64)
    azimuth = torch.deg2rad(span_deg * along)
    elevation = torch.deg2rad(elevation_deg + sway_deg * torch.sin(4 * torch.pi * along))
    up_world = torch.tensor(up, dtype=torch.float64)
    ahead = torch.tensor(front, dtype=torch.float64)
    aside = torch.linalg.cross(up_world, ahead)
    level = torch.cos(azimuth)[:, None] * ahead + torch.sin(azimuth)[:, None] * aside
    toward = torch.cos(elevation)[:, None] * level + torch.sin(elevation)[:, None] * up_world
    target_world = torch.tensor(target, dtype=torch.float64)
    eyes = target_world + distance * toward
    return pinholes(look_at(eyes, target_world, up_world), focal_px, width, height)
