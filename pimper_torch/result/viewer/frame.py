"""The frame of the viewer: z up, its origin in the middle, cameras about three units away."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.rigid import invert_rigid
from pimper_torch.ground.geometry.supporting_plane import fixation
from pimper_torch.records import Cameras, Mesh, Record


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame(Record):
    """A rotation, a shift and a scale from the world to the viewer.

    Attributes:
        rotation: Its rows are the viewer's axes: x towards the reference camera, z up.
        unit: Scene units in one of the viewer.
    """

    rotation: Float[Tensor, "3 3"]
    center_world: Float[Tensor, " 3"]
    unit: float

    def points(self, points_world: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Carry points from the world to the viewer, float64 on the CPU."""
        placed = points_world.detach().cpu().double() - self.center_world
        return placed @ self.rotation.mT / self.unit

    def directions(self, vectors_world: Float[Tensor, "vector 3"]) -> Float[Tensor, "vector 3"]:
        """Carry directions from the world to the viewer, float64 on the CPU."""
        return vectors_world.detach().cpu().double() @ self.rotation.mT


@dataclass(frozen=True, slots=True, kw_only=True)
class Stand(Record):
    """A camera in the viewer.

    Attributes:
        rotation: From the camera's axes, x right, y down, z forward.
        fov: Across the height of the picture, radians.
    """

    rotation: Float[Tensor, "3 3"]
    position: Float[Tensor, " 3"]
    fov: float

    @property
    def ahead(self) -> Float[Tensor, " 3"]:
        """A point before it, as far away as the middle: what is looked at turns about it."""
        return self.position + self.position.norm() * self.rotation[:, 2]

    @property
    def up(self) -> Float[Tensor, " 3"]:
        """Up of the viewer, turned about the line of sight as the picture is."""
        up, right = self.rotation.new_tensor([0.0, 0.0, 1.0]), self.rotation[:, 0]
        return normalize(up - (up @ right) * right, dim=0)


def stand_of(cameras: Cameras, view: int, frame: Frame) -> Stand:
    """Put a camera in the viewer."""
    world_from_cam = invert_rigid(cameras.cam_from_world[view].detach().cpu().double())
    height, focal_px = float(cameras.sizes_px[view, 1]), float(cameras.intrinsics[view, 1, 1])
    return Stand(
        rotation=frame.rotation @ world_from_cam[:3, :3],
        position=frame.points(world_from_cam[None, :3, 3])[0],
        fov=2 * math.atan(height / 2 / focal_px),
    )


def frame_of_cameras(
    cameras: Cameras, reference: int, points_world: Float[Tensor, "point 3"]
) -> Frame:
    """Stand the scene on its feet as the photographs, taken together, show it.

    Args:
        reference: View that the x axis points to.
        points_world: Of the object; their median is the origin. Without any, it is where the
            photographs are directed to.
    """
    poses = cameras.cam_from_world.detach().cpu().double()
    up = normalize(-poses[:, 1, :3].mean(dim=0), dim=0)
    centers = invert_rigid(poses)[:, :3, 3]
    if len(points_world):
        middle = points_world.detach().cpu().double().median(dim=0).values
    else:
        middle = fixation(poses).fixation_world
    away = centers - middle
    x = normalize(away[reference] - (away[reference] @ up) * up, dim=0)
    return Frame(
        rotation=torch.stack([x, torch.linalg.cross(up, x), up]),
        center_world=middle,
        unit=float(away.norm(dim=1).median()) / 3,
    )


def frame_of_mesh(mesh: Mesh) -> Frame:
    """Centre a mesh without cameras and keep its axes."""
    low, high = mesh.vertices_world.detach().cpu().double().aminmax(dim=0)
    return Frame(
        rotation=torch.eye(3, dtype=torch.float64),
        center_world=(low + high) / 2,
        unit=float((high - low).norm()) / 3,
    )
