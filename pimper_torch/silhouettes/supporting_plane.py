"""Where the cameras look, and the plane that the object stands on, from the sparse cloud."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.records import Cameras, Record, SparseScene

_TRIALS = 2000  # three good points of fifteen in a hundred are missed with probability 0.001
_MIN_POINTS = 20


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Fixation(Record):
    """Where the cameras look.

    Attributes:
        fixation_world: The point nearest to all optical axes.
        distance: Of the cameras from it, their median, scene units.
    """

    fixation_world: Float[Tensor, "3"]
    distance: Float[Tensor, ""]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Plane(Record):
    """A plane with cameras on one side.

    Attributes:
        normal_world: Unit, towards the cameras.
        offset: The plane is where the normal's product with a point is this.
    """

    normal_world: Float[Tensor, "3"]
    offset: Float[Tensor, ""]

    def height_of(self, points_world: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Give the distance above the plane, on the cameras' side."""
        return points_world @ self.normal_world - self.offset


def fixation(cameras: Cameras) -> Fixation:
    """Find the point nearest to all optical axes in the least-squares sense.

    Parallel axes meet nowhere: then it is as far away as the cameras are apart.
    """
    axes = cameras.cam_from_world[:, 2, :3].double()
    eyes = cameras.centers_world.double()
    across = torch.eye(3).to(axes) - axes[:, :, None] * axes[:, None, :]
    # The regularization is what axes within 1 degree of parallel would give.
    near = 3e-4 * len(axes) * torch.eye(3).to(axes)
    centre = eyes.mean(dim=0)
    spread = (eyes - centre).norm(dim=1).mean()
    prior = centre + spread * axes.mean(dim=0)
    right = (across @ eyes[..., None])[..., 0].sum(dim=0) + near @ prior
    fixation = torch.linalg.solve(across.sum(dim=0) + near, right)
    distance = (eyes - fixation).norm(dim=1).median()
    return Fixation(
        fixation_world=fixation.to(cameras.cam_from_world),
        distance=distance.to(cameras.cam_from_world),
    )


def well_tracked(scene: SparseScene, min_views: int = 3) -> Bool[Tensor, " point"]:
    """Mark points that enough views see."""
    return scene.observed.sum(dim=1) >= min_views


def supporting_plane(
    points_world: Float[Tensor, "point 3"],
    cameras: Cameras,
    *,
    tolerance: float,
    min_on: float,
    max_below: float,
    generator: torch.Generator,
) -> Plane | None:
    """Find the plane that the object stands on, by RANSAC.

    Args:
        points_world: Well tracked.
        cameras: All on its upper side.
        tolerance: Distance from the plane up to which a point lies on it, scene units.
        min_on: Fraction of the points that must lie on it.
        max_below: Fraction of the points that may lie below it.
        generator: Draws the trials.

    Returns:
        ``None`` where no plane has enough points on it and few enough below. Among those that
        do, the one with most points, refitted to them.
    """
    count = len(points_world)
    if count < _MIN_POINTS:
        return None
    drawn = torch.randint(count, (_TRIALS, 3), generator=generator)
    a, b, c = points_world[drawn.to(points_world.device)].unbind(dim=1)
    normals = normalize(torch.linalg.cross(b - a, c - a), dim=1)
    offsets = (normals * a).sum(dim=1)
    towards = (cameras.centers_world @ normals.mT - offsets).mean(dim=0).sign()
    normals, offsets = towards[:, None] * normals, towards * offsets
    eyes_above = (cameras.centers_world @ normals.mT > offsets).all(dim=0)
    height = points_world @ normals.mT - offsets
    on = (height.abs() < tolerance).double().mean(dim=0)
    below = (height < -tolerance).double().mean(dim=0)
    fits = eyes_above & (on >= min_on) & (below < max_below)
    if not bool(fits.any()):
        return None
    best = torch.where(fits, on, -1).argmax()
    plane = Plane(normal_world=normals[best], offset=offsets[best])
    for _ in range(3):
        plane = _refitted(points_world[plane.height_of(points_world).abs() < tolerance], plane)
    return plane


def _refitted(points: Float[Tensor, "point 3"], plane: Plane) -> Plane:
    centre = points.mean(dim=0)
    normal = torch.linalg.svd(points - centre, full_matrices=False).Vh[2]
    normal = normal * torch.where(normal @ plane.normal_world < 0, -1.0, 1.0).to(normal)
    return Plane(normal_world=normal, offset=normal @ centre)
