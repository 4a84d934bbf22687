"""Tangent plane at each point of a sparse cloud, and the views of it."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import transform
from pimper_torch.records import Cameras, Record
from pimper_torch.sfm.matching import MOST_PAIRED

# Points round one that tell its normal.
_NEIGHBOURS = 16

# Cosine to the mean of the rays at which a normal is no longer believed.
_MIN_FACING = 0.5

# Cosine between normal and ray down to which a view is worth asking.
_MIN_COSINE = 0.35

# Views that a point is looked for in, where there are many, those that see it first; see
# docs/decisions.md.
_MOST_CANDIDATES = 24

# Pairs of points and views at once: 100 MB of rays.
_AT_ONCE = 2**22


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Tangents(Record):
    """Planes through points, float64.

    Attributes:
        steps_world: Two vectors along the plane, right-angled and equally long: about a pixel of
            the reference view each.
        reference: The view that shows the plane best among those that see the point.
        candidates: Views in front of the plane that have the point in their image; not the
            reference.
    """

    points_world: Float[Tensor, "point 3"]
    steps_world: Float[Tensor, "point 2 3"]
    reference: Int[Tensor, " point"]
    candidates: Bool[Tensor, "point view"]


def tangents(
    points_world: Float[Tensor, "point 3"], observed: Bool[Tensor, "point view"], cameras: Cameras
) -> Tangents:
    """Lay a plane through every point and choose the views to look for it in.

    Args:
        observed: Which views see which points, every point in one at least.
        cameras: In float64, like the points.
    """
    at_once = max(1, _AT_ONCE // cameras.num_views)
    points, seen = torch.split(points_world, at_once), torch.split(observed, at_once)
    towards = [_towards(some, by, cameras) for some, by in zip(points, seen, strict=True)]
    normals = torch.split(plane_normals(points_world, torch.cat(towards)), at_once)
    laid = zip(points, seen, normals, strict=True)
    return Tangents.cat([_laid(some, by, across, cameras) for some, by, across in laid])


def _towards(
    points_world: Float[Tensor, "point 3"], observed: Bool[Tensor, "point view"], cameras: Cameras
) -> Float[Tensor, "point 3"]:
    """Return the mean directions to the views that see points."""
    rays = normalize(cameras.centers_world - points_world[:, None], dim=-1)
    return normalize((rays * observed[..., None]).sum(dim=1), dim=-1)


def _laid(
    points_world: Float[Tensor, "point 3"],
    observed: Bool[Tensor, "point view"],
    normals: Float[Tensor, "point 3"],
    cameras: Cameras,
) -> Tangents:
    """Lay planes of known normals."""
    rays = cameras.centers_world - points_world[:, None]
    distance = rays.norm(dim=-1)
    cosine = (normalize(rays, dim=-1) * normals[:, None]).sum(dim=-1)
    focals = cameras.intrinsics[:, 0, 0]
    sharpness = torch.where(observed, cosine.clamp_min(1e-3) * focals / distance, 0)
    reference = sharpness.argmax(dim=1)
    here = reference[:, None]
    pixel = (distance / focals).gather(1, here)
    # Foreshortened along one axis, a pixel covers more of the plane.
    pixel = pixel / cosine.gather(1, here).clamp(_MIN_COSINE, 1).sqrt()
    pixels, depth = project(points_world, cameras.cam_from_world, cameras.intrinsics)
    sizes = cameras.sizes_px[:, None].to(pixels)
    inside = ((pixels > 0) & (pixels < sizes)).all(dim=-1) & (depth > 0)
    candidates = (inside.mT & (cosine > _MIN_COSINE)).scatter(1, here, value=False)
    if cameras.num_views > MOST_PAIRED:
        most = torch.full_like(here, _MOST_CANDIDATES)
        seen = evenly(candidates & observed, most)
        left = most - seen.sum(dim=1, keepdim=True)
        candidates = seen | evenly(candidates & ~observed, left)
    return Tangents(
        points_world=points_world,
        steps_world=pixel[:, None] * _along(normals),
        reference=reference,
        candidates=candidates,
    )


def evenly(
    candidates: Bool[Tensor, "point view"], most: Int[Tensor, "point 1"]
) -> Bool[Tensor, "point view"]:
    """Keep so many views of each point at most, evenly spread among the candidates."""
    place = candidates.cumsum(dim=1) * most
    count = torch.maximum(candidates.sum(dim=1, keepdim=True), most).clamp_min(1)
    return candidates & (place // count > (place - most) // count)


def plane_normals(
    points: Float[Tensor, "point 3"], towards: Float[Tensor, "point 3"]
) -> Float[Tensor, "point 3"]:
    """Return the unit normals of the planes that points and their nearest ones lie on.

    Args:
        towards: Unit; what a normal points to, and what it is where neighbours say otherwise.
    """
    places = points.detach().cpu().numpy()
    count = min(_NEIGHBOURS, len(places))
    _, nearest = cKDTree(places).query(places, k=list(range(1, count + 1)))
    around = points[torch.from_numpy(nearest).to(points.device)]
    steps = around - around.median(dim=1, keepdim=True).values  # a stray neighbour shifts no median
    axes = torch.linalg.eigh(steps.mT @ steps).eigenvectors
    across = axes[:, :, 0]
    facing = (across * towards).sum(dim=-1, keepdim=True)
    return torch.where(facing.abs() > _MIN_FACING, across * facing.sign(), towards)


def plane_homographies(
    tangent: Tangents, cameras: Cameras, view: int, some: Int[Tensor, " chosen"]
) -> Float[Tensor, "chosen 3 3"]:
    """Return the homographies from planes, in steps from the centre, to a view's pixels."""
    steps = tangent.steps_world[some]
    centre = transform(cameras.cam_from_world[view], tangent.points_world[some])
    rotated = steps @ cameras.cam_from_world[view, :3, :3].mT
    return cameras.intrinsics[view] @ torch.cat([rotated, centre[:, None]], dim=1).mT


def _along(normals: Float[Tensor, "point 3"]) -> Float[Tensor, "point 2 3"]:
    """Return two unit vectors at right angles to each normal and to one another."""
    axis = torch.eye(3).to(normals)[normals.abs().argmin(dim=1)]
    first = normalize(torch.linalg.cross(normals, axis), dim=-1)
    return torch.stack([first, torch.linalg.cross(normals, first)], dim=1)
