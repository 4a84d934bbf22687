"""Where the cameras look, and the plane that the object stands on, from the sparse cloud."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.rigid import invert_rigid
from pimper_torch.ground.shapes import Points, Scalar, Scalars, Vectors
from pimper_torch.records import Record, SparseScene

# Distance up to which a point is on the plane, as a fraction of the cameras' distance; the fraction
# of the points that must be on it, and that which may be below. Chosen on the four rendered scenes
# and the skull (benchmarks/silhouettes.py).
PLANE_TOLERANCE = 0.004
_MIN_ON, _MAX_BELOW = 0.08, 0.05


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Fixation(Record):
    """Where the cameras look.

    Attributes:
        fixation_world: The point nearest to all optical axes.
        distance: Of the cameras from it, their median, scene units.
    """

    fixation_world: Float[Tensor, "3"]
    distance: Scalar


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Plane(Record):
    """A plane with cameras on one side.

    Attributes:
        normal_world: Unit, towards the cameras.
        offset: The plane is where the normal's product with a point is this.
    """

    normal_world: Float[Tensor, "3"]
    offset: Scalar

    def height_of(self, points_world: Vectors) -> Scalars:
        """Return the distance above the plane, on the cameras' side."""
        return points_world @ self.normal_world - self.offset


def fixation(cam_from_world: Float[Tensor, "view 4 4"]) -> Fixation:
    """Find the point nearest to all optical axes in the least-squares sense.

    Parallel axes meet nowhere: then it is as far away as the cameras are apart.
    """
    poses = cam_from_world.double()
    axes, eyes = poses[:, 2, :3], invert_rigid(poses)[:, :3, 3]
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
        fixation_world=fixation.to(cam_from_world), distance=distance.to(cam_from_world)
    )


def well_tracked(scene: SparseScene) -> Bool[Tensor, " point"]:
    """Find points that at least three views see."""
    return scene.observed.sum(dim=1) >= 3


def supporting_plane(
    points_world: Points, eyes_world: Float[Tensor, "view 3"], distance: float
) -> Plane | None:
    """Find the plane that the object stands on, by RANSAC.

    Args:
        distance: Of the cameras from the fixation point, scene units.

    Returns:
        ``None`` where no plane has enough points on it and few enough below. Among those that
        do, the one with most points, refitted to them.
    """
    count = len(points_world)
    if count < 20:
        return None
    tolerance, generator = PLANE_TOLERANCE * distance, torch.Generator()
    # Three good points of fifteen in a hundred are missed with probability 0.001.
    drawn = torch.randint(count, (2000, 3), generator=generator.manual_seed(0))
    a, b, c = points_world[drawn.to(points_world.device)].unbind(dim=1)
    normals = normalize(torch.linalg.cross(b - a, c - a), dim=1)
    offsets = (normals * a).sum(dim=1)
    towards = (eyes_world @ normals.mT - offsets).mean(dim=0).sign()
    normals, offsets = towards[:, None] * normals, towards * offsets
    eyes_above = (eyes_world @ normals.mT > offsets).all(dim=0)
    height = points_world @ normals.mT - offsets
    on = (height.abs() < tolerance).double().mean(dim=0)
    below = (height < -tolerance).double().mean(dim=0)
    drawn_apart = normals.norm(dim=1) > 0.5  # or one was drawn twice, and the rest is rounding
    fits = drawn_apart & eyes_above & (on >= _MIN_ON) & (below < _MAX_BELOW)
    if not bool(fits.any()):
        return None
    best = torch.where(fits, on, -1).argmax()
    plane = Plane(normal_world=normals[best], offset=offsets[best])
    for _ in range(3):
        close = points_world[plane.height_of(points_world).abs() < tolerance]
        centre = close.mean(dim=0)
        normal = torch.linalg.svd(close - centre, full_matrices=False).Vh[2]
        normal = normal * torch.where(normal @ plane.normal_world < 0, -1.0, 1.0).to(normal)
        plane = Plane(normal_world=normal, offset=normal @ centre)
    return plane
