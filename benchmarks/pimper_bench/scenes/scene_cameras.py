"""Camera positions of rendered scenes."""

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.spatial import ConvexHull
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.geometry.rigid import rigid
from pimper_torch.records import Cameras

FRONT, UP = (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)


def panned(cameras: Cameras, shift_px: Float[Tensor, "view 2"]) -> Cameras:
    """Rotate cameras about their centres, without roll, so that the image shifts.

    Args:
        shift_px: New position of the former principal point, relative to the principal point.
    """
    focal_px = cameras.intrinsics.diagonal(dim1=-2, dim2=-1)[:, :2]
    toward = normalize(homogeneous(shift_px / focal_px), dim=-1)
    x, y, z = toward.unbind(dim=-1)
    # Rodrigues' formula of the shortest rotation from the z axis to ``toward``.
    rotation = torch.stack(
        [
            torch.stack([1 - x * x / (1 + z), -x * y / (1 + z), x], dim=-1),
            torch.stack([-x * y / (1 + z), 1 - y * y / (1 + z), y], dim=-1),
            torch.stack([-x, -y, z], dim=-1),
        ],
        dim=-2,
    )
    pan = rigid(rotation, torch.zeros_like(toward))
    return cameras.replace(cam_from_world=pan @ cameras.cam_from_world)


def cropped(cameras: Cameras, shift_px: Float[Tensor, "view 2"]) -> Cameras:
    """Crop photographs of the same size around a shifted centre: the image shifts."""
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, :2, 2] += shift_px
    return cameras.replace(intrinsics=intrinsics)


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
    """Place cameras on an arc around a target, looking at it; float64.

    The defaults face flat shapes such as :class:`.EndlessPlane` from above.

    Args:
        span_deg: From the first camera to the last, about ``up``.
        elevation_deg: Mean height of the arc over the plane perpendicular to ``up``.
        sway_deg: Amplitude of the elevation along the arc.
        front: Towards the centre of the arc; must be perpendicular to ``up``.
    """
    toward_world = arc_directions(
        num_views,
        span_deg=span_deg,
        elevation_deg=elevation_deg,
        sway_deg=sway_deg,
        front=front,
        up=up,
    )
    target_world = torch.tensor(target, dtype=torch.float64)
    eyes = target_world + distance * toward_world
    up_world = torch.tensor(up, dtype=torch.float64)
    return pinholes(look_at(eyes, target_world, up_world), focal_px, width, height)


def arc_directions(
    num_views: int,
    *,
    span_deg: float,
    elevation_deg: float,
    sway_deg: float,
    front: tuple[float, float, float] = FRONT,
    up: tuple[float, float, float] = UP,
) -> Float[Tensor, "view 3"]:
    """Return the unit directions from the target to the cameras of :func:`arc_cameras`."""
    along = torch.linspace(-0.5, 0.5, num_views, dtype=torch.float64)
    azimuth = torch.deg2rad(span_deg * along)
    elevation = torch.deg2rad(elevation_deg + sway_deg * torch.sin(4 * torch.pi * along))
    return _directions(azimuth, elevation, front, up)


def turntable_directions(num_views: int, *, elevation_deg: float) -> Float[Tensor, "view 3"]:
    """Return directions once around the object in equal steps at one height, as on a turntable."""
    return arc_directions(
        num_views,
        span_deg=360.0 * (num_views - 1) / num_views,
        elevation_deg=elevation_deg,
        sway_deg=0.0,
    )


def handheld_directions(
    num_views: int, generator: torch.Generator, *, elevation_deg: float
) -> Float[Tensor, "view 3"]:
    """Return directions once around the object at each of three heights, with a hand's shake.

    Args:
        elevation_deg: Of the first third; then 18 degrees higher, then 14 lower, all limited to
            between 8 and 75.
    """
    third = torch.arange(num_views) * 3 // num_views
    per_height = torch.bincount(third, minlength=3)[third]
    step = torch.arange(num_views) - torch.searchsorted(third, third)
    shake = torch.rand(3, num_views, generator=generator, dtype=torch.float64) - 0.5
    azimuth = 2 * torch.pi * (step + 0.6 * shake[0] + third / 3) / per_height
    heights = elevation_deg + azimuth.new_tensor([0.0, 18.0, -14.0])[third] + 8 * shake[1]
    return _directions(azimuth, torch.deg2rad(heights.clamp(8.0, 75.0)), FRONT, UP)


def distance_to_fit(
    toward_world: Float[Tensor, "view 3"],
    points_world: Float[Tensor, "point 3"],
    target_world: Float[Tensor, " 3"],
    *,
    focal_px: float,
    width: float,
    height: float,
    fill: float,
) -> float:
    """Return the minimum distance of cameras at which all points are in all images.

    Args:
        toward_world: Unit, from the target to the cameras, which look at it.
        fill: Maximum fraction of the image, along its tighter side, covered by the points.
    """
    up_world = points_world.new_tensor(UP)
    rotation = look_at(target_world + toward_world, target_world, up_world)[:, :3, :3]
    x, y, z = ((points_world - target_world) @ rotation.mT).unbind(dim=-1)
    # At distance d a point is imaged f x / (d + z) from the centre; this has to be half the side.
    wide = focal_px * x.abs() / (fill * width / 2) - z
    high = focal_px * y.abs() / (fill * height / 2) - z
    return float(torch.maximum(wide, high).amax())


def aim_to_fit(
    toward_world: Float[Tensor, "view 3"], points_world: Float[Tensor, "point 3"], **picture: float
) -> tuple[Float[Tensor, " 3"], float]:
    """Return the target and distance of cameras that show all points as large as possible.

    Args:
        picture: Arguments of :func:`distance_to_fit`.
    """
    hull = points_world[torch.from_numpy(ConvexHull(points_world.numpy()).vertices).long()]

    centre = (hull.amin(dim=0) + hull.amax(dim=0)) / 2
    mean_toward = toward_world.mean(dim=0)

    def distance(target: Float[Tensor, " 3"]) -> float:
        return distance_to_fit(toward_world, hull, target, **picture)

    def cost(values: np.ndarray) -> float:
        # Distance of the cameras from the object's centre: the distance from the target would
        # decrease as the target moves towards the cameras. Convex.
        target = torch.from_numpy(values)
        off = target - centre
        return distance(target) + float(off @ mean_toward) + 0.01 * float(off @ off)

    result = minimize(cost, centre.numpy(), method="Nelder-Mead", options={"xatol": 1e-3})
    target = torch.from_numpy(result.x)
    return target, distance(target)


def _directions(
    azimuth: Float[Tensor, " view"],
    elevation: Float[Tensor, " view"],
    front: tuple[float, float, float],
    up: tuple[float, float, float],
) -> Float[Tensor, "view 3"]:
    up_world, front_world = azimuth.new_tensor(up), azimuth.new_tensor(front)
    side = torch.linalg.cross(up_world, front_world)
    horizontal = torch.cos(azimuth)[:, None] * front_world + torch.sin(azimuth)[:, None] * side
    return torch.cos(elevation)[:, None] * horizontal + torch.sin(elevation)[:, None] * up_world
