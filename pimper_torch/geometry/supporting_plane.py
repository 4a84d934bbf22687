"""The fixation point of the cameras, and the supporting plane, from the sparse cloud."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.rigid import invert_rigid
from pimper_torch.records import Record, SparseScene
from pimper_torch.records.shapes import Points, Scalar, Scalars, Vectors

# Fractions of the cameras' distance: greatest distance of a point on the plane, and side of the
# cells in which points count together. Minimum fraction on the plane and maximum fraction below, of
# the points or else of the cells: docs/decisions.md, "The supporting plane".
PLANE_TOLERANCE, _CELL = 0.004, 0.05
_OF_POINTS, _OF_CELLS = (0.08, 0.05), (0.4, 0.1)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Fixation(Record):
    """Fixation point of the cameras.

    Attributes:
        fixation_world: The point nearest to all optical axes.
        distance: Median distance of the cameras from it, scene units.
    """

    fixation_world: Float[Tensor, "3"]
    distance: Scalar


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Plane(Record):
    """A plane with cameras on one side.

    Attributes:
        normal_world: Unit, towards the cameras.
        offset: Dot product of the normal with a point of the plane.
    """

    normal_world: Float[Tensor, "3"]
    offset: Scalar

    def height_of(self, points_world: Vectors) -> Scalars:
        """Return the signed distance from the plane, positive on the cameras' side."""
        return points_world @ self.normal_world - self.offset


def fixation(cam_from_world: Float[Tensor, "view 4 4"]) -> Fixation:
    """Compute the point nearest to all optical axes in the least-squares sense.

    For parallel axes it is in front of the cameras' mean, at their mean distance from it.
    """
    poses = cam_from_world.double()
    axes, eyes = poses[:, 2, :3], invert_rigid(poses)[:, :3, 3]
    across = torch.eye(3).to(axes) - axes[:, :, None] * axes[:, None, :]
    # The regularization is as large as the constraint of axes within 1 degree of parallel.
    damping = 3e-4 * len(axes) * torch.eye(3).to(axes)
    centre = eyes.mean(dim=0)
    spread = (eyes - centre).norm(dim=1).mean()
    prior = centre + spread * axes.mean(dim=0)
    rhs = (across @ eyes[..., None])[..., 0].sum(dim=0) + damping @ prior
    fixation = torch.linalg.solve(across.sum(dim=0) + damping, rhs)
    distance = (eyes - fixation).norm(dim=1).median()
    return Fixation(
        fixation_world=fixation.to(cam_from_world), distance=distance.to(cam_from_world)
    )


def well_tracked(scene: SparseScene) -> Bool[Tensor, " point"]:
    """Return the mask of points that at least three views observe."""
    return scene.observed.sum(dim=1) >= 3


def supporting_plane(
    points_world: Points, eyes_world: Float[Tensor, "view 3"], distance: float
) -> Plane | None:
    """Find the supporting plane of the object by RANSAC.

    Points count by the space in which they are, not by their number: the object usually has more
    texture than the plane, and may itself have a flat base.

    Args:
        distance: Of the cameras from the fixation point, scene units.

    Returns:
        The plane with most cells of points, refitted to them; ``None`` if no plane has enough of
        them on it and few enough below.
    """
    count = len(points_world)
    if count < 20:
        return None
    tolerance, generator = PLANE_TOLERANCE * distance, torch.Generator().manual_seed(0)
    cells = (points_world / (_CELL * distance)).floor().long()
    _, cell, counts = torch.unique(cells, dim=0, return_inverse=True, return_counts=True)
    weight = 1 / (len(counts) * counts[cell].to(points_world))
    # If 15 % of the cells are on the plane, no triple of them is drawn with probability 0.001.
    triples = torch.multinomial(weight.cpu(), 6000, replacement=True, generator=generator)
    a, b, c = points_world[triples.reshape(2000, 3).to(points_world.device)].unbind(dim=1)
    normals = normalize(torch.linalg.cross(b - a, c - a), dim=1)
    offsets = (normals * a).sum(dim=1)
    towards = (eyes_world @ normals.mT - offsets).mean(dim=0).sign()
    normals, offsets = towards[:, None] * normals, towards * offsets
    eyes_above = (eyes_world @ normals.mT > offsets).all(dim=0)
    height = points_world @ normals.mT - offsets
    shares = torch.stack([torch.full_like(weight, 1 / count), weight])
    on = shares @ (height.abs() < tolerance).to(weight)
    below = shares @ (height < -tolerance).to(weight)
    least, most = weight.new_tensor([_OF_POINTS, _OF_CELLS]).mT[..., None]
    distinct = normals.norm(dim=1) > 0.5  # with a point drawn twice, the normal is rounding noise
    fits = distinct & eyes_above & ((on >= least) & (below < most)).any(dim=0)
    if not bool(fits.any()):
        return None
    best = torch.where(fits, on[1], -1).argmax()
    plane = Plane(normal_world=normals[best], offset=offsets[best])
    for _ in range(3):
        close = points_world[plane.height_of(points_world).abs() < tolerance]
        centre = close.mean(dim=0)
        normal = torch.linalg.svd(close - centre, full_matrices=False).Vh[2]
        normal = normal * torch.where(normal @ plane.normal_world < 0, -1.0, 1.0).to(normal)
        plane = Plane(normal_world=normal, offset=normal @ centre)
    return plane
