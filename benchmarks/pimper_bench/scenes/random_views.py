"""Random cameras around an object, and random light of each of their photographs."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.scenes.random_draws import Draws
from pimper_bench.scenes.scene_cameras import UP, aim_to_fit, arc_directions, panned
from pimper_bench.scenes.scene_lights import PointLight
from pimper_bench.scenes.whole_scene import rotated_about
from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import rigid
from pimper_torch.records import Cameras

_LARGEST_CUT = 0.02  # of an image's side, that a shifted or rolled object may be cut
_FAINTEST, _SOFTEST = 0.03, 0.5  # ambient light as a fraction of all


@dataclass(frozen=True, slots=True, kw_only=True)
class Path:
    """Cameras, and the poses of the room relative to the object.

    Attributes:
        turning: True if the object turns in front of a camera at rest in the room.
    """

    cameras: Cameras
    world_from_room: Float[Tensor, "view 4 4"]
    turning: bool


def random_cameras(
    draws: Draws, points: Float[Tensor, "point 3"], num_views: int, width: int, height: int
) -> Path:
    """Draw cameras on an arc, or all round, that see all points; 15 % are of a turntable."""
    turning = draws.chance(0.15)
    span_deg = draws.pick([40.0, 70.0, 120.0, 360.0 * (num_views - 1) / num_views])
    azimuth, elevation_deg = draws.uniform(0, 2 * math.pi), draws.uniform(14, 42)
    sway_deg = draws.uniform(0, min(9.0, elevation_deg - 9))
    toward = arc_directions(
        num_views,
        span_deg=span_deg,
        elevation_deg=elevation_deg,
        sway_deg=0.0 if turning else sway_deg,
        front=(math.sin(azimuth), -math.cos(azimuth), 0.0),
    )
    focal_px = width * draws.log_uniform(1.05, 2.6)
    target, distance = aim_to_fit(
        toward,
        points,
        focal_px=focal_px,
        width=width,
        height=height,
        fill=draws.uniform(0.55, 0.95),
    )
    nearness = 1 + 0.12 * draws.vector(0, 1, num_views)
    roll = torch.deg2rad(draws.uniform(0, 10) * draws.vector(-1, 1, num_views))
    size_px = focal_px * float((points.amax(dim=0) - points.amin(dim=0)).amax()) / distance
    shift = 0.08 * size_px * draws.vector(0, 1, num_views, 1) * _in_circle(draws, num_views)
    if turning:
        target = target * target.new_tensor(UP)
        nearness, roll, shift = (values[:1].expand_as(values) for values in (nearness, roll, shift))
    for _ in range(60):
        eyes = target + distance * nearness[:, None] * toward
        poses = _rolled(look_at(eyes, target, target.new_tensor(UP)), roll)
        cameras = panned(pinholes(poses, focal_px, width, height), shift)
        cut = _cut(cameras, points)
        if not bool((cut > 0).any()):
            break
        nearness = nearness * (1.03 if turning else torch.where(cut > 0, 1.03, 1.0))
    azimuths = torch.atan2(toward[:, 0], -toward[:, 1])
    rooms = rotated_about(torch.zeros(3).to(azimuths), azimuths if turning else 0 * azimuths)
    return Path(cameras=cameras, world_from_room=rooms, turning=turning)


def _in_circle(draws: Draws, count: int) -> Float[Tensor, "view 2"]:
    angle = draws.vector(0, 2 * math.pi, count)
    return torch.stack([angle.cos(), angle.sin()], dim=1)


def _rolled(
    cam_from_world: Float[Tensor, "view 4 4"], roll: Float[Tensor, " view"]
) -> Float[Tensor, "view 4 4"]:
    """Turn cameras about their optical axes."""
    cosine, sine, zero = roll.cos(), roll.sin(), torch.zeros_like(roll)
    rows = [[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, zero + 1]]
    rotation = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    return rigid(rotation, rotation.new_zeros(len(roll), 3)) @ cam_from_world


def _cut(cameras: Cameras, points: Float[Tensor, "point 3"]) -> Float[Tensor, " view"]:
    """Return by how much of its side each image cuts too much of the points, or less than 0."""
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    size = cameras.sizes_px[:, None].to(pixels)
    beyond = torch.maximum(-pixels, pixels - size) / size
    return beyond.amax(dim=(1, 2)) - _LARGEST_CUT


def random_lights(
    draws: Draws, cameras: Cameras, centre: Float[Tensor, " 3"], radius: float
) -> list[PointLight]:
    """Draw the light of each photograph, whose total at the object is 1.

    A quarter of the captures have a flash beside the camera, a third lamps of varying colour, and
    a quarter the soft light of a window.
    """
    flash, coloured, window = draws.chance(0.25), draws.chance(1 / 3), draws.chance(0.25)
    middle, spread, warmth = draws.uniform(0, 1), draws.uniform(0, 0.5), draws.uniform(0.05, 0.3)
    lights = []
    for view, eye in enumerate(cameras.centers_world):
        place = min(max(middle + spread * draws.uniform(-1, 1), 0.0), 1.0)
        ambient = _FAINTEST * (_SOFTEST / _FAINTEST) ** place
        soft = draws.uniform(0.1, 0.7) if window else 0.0
        # Half of the ambient light, more or less, is from above one side: shadows have shading.
        sided = ambient * draws.uniform(0.2, 0.9)
        colour = (warmth * draws.vector(-1, 1, 3)).exp()
        position = _lamp(draws, eye, centre, radius)
        if flash:
            aside = cameras.cam_from_world[view, :2, :3]  # the image's axes
            offset = draws.vector(-1, 1, 2) * (eye - centre).norm() * 0.08
            position = eye + offset @ aside
            position[2] = position[2].clamp_min(0.3)
        lights.append(
            PointLight(
                position=position.float(),
                target=centre.float(),
                irradiance=(1 - ambient) * (1 - soft),
                ambient=ambient - sided,
                window=((1.5 * sided + (1 - ambient) * soft) * _above(draws)).float(),
                colour=(colour / colour.mean()).float() if coloured else None,
            )
        )
    return lights


def _lamp(
    draws: Draws, eye: Float[Tensor, " 3"], centre: Float[Tensor, " 3"], radius: float
) -> Float[Tensor, " 3"]:
    """Draw a position within 90 degrees of the camera's direction, 10 degrees above the table."""
    away = radius * draws.uniform(3, 8)
    direction = normalize(eye - centre, dim=0)
    for _ in range(200):
        drawn = draws.direction()
        if float(drawn @ direction) > 0 and float(drawn[2]) > 0.17:
            return centre + away * drawn
    return centre + away * direction


def _above(draws: Draws) -> Float[Tensor, " 3"]:
    """Draw the direction to a window."""
    direction = draws.direction()
    direction[2] = direction[2].abs() + 0.2
    return normalize(direction, dim=0)
