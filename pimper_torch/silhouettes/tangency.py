"""Where contour rays touch the surface."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.config import Range, require_ranges
from pimper_torch.parallel import num_workers
from pimper_torch.records import Cameras, ContourPoints, ContourRays
from pimper_torch.silhouettes.hull import Hull

# Cosine between the offset from the nearest point's disc and its normal, from which on a place
# is below the surface: beside the border of what is known, none is.
_ALONG_NORMAL = 0.9

# Points, itself included, to the last of which a point's disc reaches: those round it in a
# triangle mesh.
_NEIGHBOURS = 7


@dataclass(frozen=True, slots=True, kw_only=True)
class TangencyConfig:
    """Settings of the choice of positions on contour rays.

    Attributes:
        steps: Places that are looked at on each ray, over the object's depth.
        refined_steps: Between those beside the best one.
        tolerance_px: How far outside the visual hull the place may lie.
        ambiguous_px: Two positions on a ray, one behind the other, both so near to the surface
            that they differ by less than this: nothing tells which of them it touches.
    """

    steps: Annotated[int, Range(least=4, most=100_000)] = 128
    refined_steps: Annotated[int, Range(least=2, most=100_000)] = 12
    tolerance_px: Annotated[float, Range(least=0, most=65_535)] = 1.5
    ambiguous_px: Annotated[float, Range(least=0, most=65_535)] = 2.0

    def __post_init__(self) -> None:
        require_ranges(self, "touch")


@torch.no_grad()
def contour_points(
    rays: ContourRays,
    cameras: Cameras,
    hull: Hull,
    points_world: Float[Tensor, "point 3"],
    normals_world: Float[Tensor, "point 3"],
    config: TangencyConfig | None = None,
) -> ContourPoints:
    """Find where each contour ray touches a surface, of which points with normals are given.

    It touches where, of all positions inside the visual hull, the ray runs deepest below the
    surface or, if it passes the surface by, nearest to it. The place may be off along the ray:
    the surface is tangent there, so that this matters little across it.

    Args:
        points_world: Of the surface as far as it is known: a cloud or a mesh's vertices. Without
            any, positions are in the centre of what is in the hull.

    Returns:
        At most one place a ray. A ray has none where it does not meet the hull, and where
        two surfaces, one behind the other, are as near to it: parts that hide each other.
        A constant to autograd.
    """
    config = config or TangencyConfig()
    centers = cameras.centers_world[rays.view]
    focal = cameras.intrinsics[rays.view, 0, 0]
    low, high = _depths_in_box(hull, centers, rays.rays_world)
    depth = low + torch.linspace(0, 1, config.steps).to(low) * (high - low)
    pixel = depth.mean(dim=1) / focal
    surface = _SignedDistance(points_world, normals_world) if len(points_world) else None
    cost = _costs(rays, centers, depth, hull, config.tolerance_px * pixel, surface)
    clear = ~ambiguous(cost, config.ambiguous_px * pixel)
    (met,) = torch.nonzero(cost.isfinite().any(dim=1) & clear, as_tuple=True)
    best = depth[met].gather(1, cost[met].argmin(dim=1, keepdim=True))
    offset = torch.linspace(-1, 1, 2 * config.refined_steps + 1).to(low)
    fine = best + offset * (high - low)[met] / (config.steps - 1)
    tolerance = config.tolerance_px * pixel[met]
    cost = _costs(rays.take(met), centers[met], fine, hull, tolerance, surface)
    found = fine.gather(1, cost.argmin(dim=1, keepdim=True))
    sigma = rays.sigma_px[met] * found[:, 0] / focal[met]
    return ContourPoints(
        points_world=centers[met] + found * rays.rays_world[met],
        normals_world=rays.normals_world[met],
        variance=sigma.square(),
        view=rays.view[met],
        ray=met,
    )


class _SignedDistance:
    """Distance to the surface round some of its points, negative below it.

    A point stands for a disc of its tangent plane that reaches to its neighbours.
    """

    def __init__(self, points: Float[Tensor, "point 3"], normals: Float[Tensor, "point 3"]) -> None:
        positions = points.detach().cpu().double().numpy()
        self._points, self._normals, self._tree = points, normals, cKDTree(positions)

    def __call__(self, positions: Float[Tensor, "place 3"]) -> Float[Tensor, " place"]:
        _, nearest = self._tree.query(
            positions.detach().cpu().double().numpy(), workers=num_workers()
        )
        index = torch.from_numpy(nearest).to(self._points.device)
        offset, normals = positions - self._points[index], self._normals[index]
        height = (offset * normals).sum(dim=1)
        beside = (offset - height[:, None] * normals).norm(dim=1) - self._radii(index)
        distance = torch.hypot(height, beside.clamp_min(0))
        return torch.where(height < -_ALONG_NORMAL * distance, -distance, distance)

    def _radii(self, index: Int[Tensor, " place"]) -> Float[Tensor, " place"]:
        some, place = torch.unique(index, return_inverse=True)
        count = min(_NEIGHBOURS, len(self._points))
        chosen = self._points[some].detach().cpu().double().numpy()
        reach, _ = self._tree.query(chosen, k=[count], workers=num_workers())
        return torch.from_numpy(np.asarray(reach)[:, 0]).to(self._points)[place]


def _depths_in_box(
    hull: Hull, centers: Float[Tensor, "ray 3"], rays: Float[Tensor, "ray 3"]
) -> tuple[Float[Tensor, "ray 1"], Float[Tensor, "ray 1"]]:
    """Return the depths at which rays enter and leave the ball round the hull's grid."""
    corners = hull.corners_world.to(rays)
    centre, radius = corners.mean(dim=0), (corners[1] - corners[0]).norm() / 2
    square = rays.square().sum(dim=1, keepdim=True)
    along = ((centre - centers) * rays).sum(dim=1, keepdim=True) / square
    reach = radius / square.sqrt()
    return (along - reach).clamp_min(0), (along + reach).clamp_min(0)


def _costs(
    rays: ContourRays,
    centers: Float[Tensor, "ray 3"],
    depth: Float[Tensor, "ray step"],
    hull: Hull,
    tolerance: Float[Tensor, " ray"],
    surface: _SignedDistance | None,
) -> Float[Tensor, "ray step"]:
    """Return the signed distance to the surface along the rays; infinite outside the hull.

    Without a surface it is the distance to the centre of what is in the hull.
    """
    positions = centers[:, None] + depth[..., None] * rays.rays_world[:, None]
    inside = hull.depth_of(positions.to(hull.distance)) >= -tolerance[:, None].to(hull.distance)
    inside &= depth > 0
    if surface is None:
        centre = (inside * depth).sum(dim=1) / inside.sum(dim=1).clamp_min(1)
        return torch.where(inside, (depth - centre[:, None]).abs(), torch.inf)
    cost = torch.full_like(depth, torch.inf)
    cost[inside] = surface(positions[inside])
    return cost


def ambiguous(
    cost: Float[Tensor, "ray step"], tolerance: Float[Tensor, " ray"]
) -> Bool[Tensor, " ray"]:
    """Report rays that come equally near to two surfaces, one behind the other.

    Args:
        cost: Signed distance to the surface along the rays; infinite where they cannot
            touch it.
        tolerance: Difference of distances that does not count. Places are on two surfaces if the
            distance between them rises by more.
    """
    margin = tolerance[:, None]
    # Below the surface, or on it, is all the same: thick and thin parts are alike near.
    lowest = cost.amin(dim=1, keepdim=True).clamp_min(0)
    near, far = cost <= lowest + margin, cost > lowest + 2 * margin
    # A new stretch begins where positions are near again after some that are far.
    stretch = far.cumsum(dim=1)
    first = torch.where(near, stretch, cost.shape[1] + 1).amin(dim=1)
    last = torch.where(near, stretch, -1).amax(dim=1)
    return last > first
