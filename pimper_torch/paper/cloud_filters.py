"""Filters of the point cloud: points consistent with their neighbours, and a well-spread subset.

Numbers are choices, the same for all photographs.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, Delaunay, cKDTree
from torch import Tensor

from pimper_torch.geometry.surfaces import barycentric_2d
from pimper_torch.records.shapes import Faces, Pixels, PointMask, Points

PerPoint = Float[Tensor, " point"]
NearestPoints = Int[Tensor, "point neighbour"]


def occluded_points(pixels: Pixels, points_cam: Points, observed: PointMask) -> PointMask:
    """Return points that a nearer surface certainly or probably occludes in the image.

    Among the 24 nearest points in the image, those count that are nearer to the camera by more than
    3 times their lateral distance. If three or more surround the point, it is occluded; if all are
    in one half-plane, as at a contour or on a steep surface, only if the view does not observe it.
    """
    nearest = nearest_in_image(pixels, 24)
    steps = points_cam[nearest] - points_cam[:, None]
    front = (steps[..., 2] < 0) & (_steepness(points_cam, nearest) > 3.0)
    offset = pixels[nearest] - pixels[:, None]
    angle = torch.atan2(offset[..., 1], offset[..., 0])
    ordered = torch.where(front, angle, torch.inf).sort(dim=1).values
    around = ordered[:, :1] + 2 * torch.pi  # the first angle again, after the last
    gaps = torch.cat([ordered.minimum(around), around], dim=1).diff(dim=1)
    return (front.sum(dim=1) >= 3) & ((gaps.amax(dim=1) < torch.pi) | ~observed)


def consistent_points(
    pixels: Pixels, points_cam: Points, *, neighbours: int = 12, max_slope: float = 6.0
) -> PointMask:
    """Return points on the same surface as their neighbours in the image.

    A point on a different surface has a steep slope to most neighbours: ``|dz|`` over the lateral
    distance exceeds ``max_slope``. A badly triangulated point is farther from its neighbours' plane
    than half their radius. The worst are dropped first, in rounds, to protect their neighbours.
    """
    keep = torch.ones(len(pixels), dtype=torch.bool, device=pixels.device)
    neighbours = min(neighbours, len(pixels) - 1)
    for fraction in (0.9, 0.75, 0.6, 0.5):
        index = keep.nonzero()[:, 0]
        if len(index) <= neighbours:
            break
        nearest = nearest_in_image(pixels[index], neighbours)
        steep = _steepness(points_cam[index], nearest) > max_slope
        off = _deviation(points_cam[index], nearest) > 0.5
        keep[index[(steep.float().mean(dim=1) > fraction) | off]] = False
    return keep


def nearest_in_image(pixels: Pixels, count: int) -> Int[Tensor, "point near"]:
    """Return the indices of every point's nearest others, at most ``count``."""
    coordinates = pixels.detach().cpu().numpy()
    ranks = list(range(2, min(count, len(pixels) - 1) + 2))
    _, index = cKDTree(coordinates).query(coordinates, k=ranks)
    return torch.as_tensor(index, device=pixels.device)


def on_hull(pixels: Pixels) -> PointMask:
    """Return the corners of the points' convex hull in the image.

    Selected first, they extend the mesh over the complete cloud.
    """
    corners = ConvexHull(pixels.detach().cpu().double().numpy()).vertices
    marked = torch.zeros(len(pixels), dtype=torch.bool)
    marked[torch.from_numpy(corners.astype("int64"))] = True
    return marked.to(pixels.device)


def without_isolated_corners(pixels: Pixels) -> PointMask:
    """Return all points except isolated corners of the hull, which are removed repeatedly.

    A point is isolated if the distance to its third nearest point exceeds 3 times the median of
    this distance over its neighbours.
    """
    keep = torch.ones(len(pixels), dtype=torch.bool, device=pixels.device)
    while keep.sum() > 8:
        index = keep.nonzero()[:, 0]
        nearest = nearest_in_image(pixels[index], 8)
        third = (pixels[index[nearest[:, 2]]] - pixels[index]).norm(dim=-1)
        isolation = third / third[nearest].median(dim=1).values.clamp_min(1e-9)
        alone = on_hull(pixels[index]) & (isolation > 3.0)
        if not alone.any():
            break
        keep[index[alone]] = False
    return keep


def spread(pixels: Pixels, quality: PerPoint, distance_px: float) -> Int[Tensor, " chosen"]:
    """Return the indices of points at least ``distance_px`` apart, the best first."""
    coordinates = pixels.detach().cpu().numpy()
    close = cKDTree(coordinates).query_ball_point(coordinates, distance_px)
    blocked = torch.zeros(len(pixels), dtype=torch.bool)
    chosen: list[int] = []
    for point in quality.argsort(descending=True, stable=True).tolist():
        if not blocked[point]:
            chosen.append(point)
            blocked[torch.tensor(close[point])] = True
    return torch.tensor(chosen, dtype=torch.long, device=pixels.device)


def spread_to_count(pixels: Pixels, quality: PerPoint, target: int) -> Int[Tensor, " chosen"]:
    """Return the indices of about ``target`` well-spread points, by bisecting their distance."""
    if target >= len(pixels):
        return torch.arange(len(pixels), device=pixels.device)
    extent = pixels.amax(dim=0) - pixels.amin(dim=0)
    # Starts from an estimate: with a distance of the image's size all points are neighbours.
    low, high = 0.0, float(torch.maximum((extent.prod() / target).sqrt(), extent.norm() / target))
    chosen = spread(pixels, quality, high)
    while len(chosen) > target:
        low, high = high, 2 * high
        chosen = spread(pixels, quality, high)
    for _ in range(20):
        middle = (low + high) / 2
        chosen = spread(pixels, quality, middle)
        low, high = (middle, high) if len(chosen) > target else (low, middle)
    return chosen


def _steepness(points_cam: Points, nearest: NearestPoints) -> Float[Tensor, "point neighbour"]:
    steps = points_cam[nearest] - points_cam[:, None]
    return steps[..., 2].abs() / steps[..., :2].norm(dim=-1).clamp_min(1e-12)


def _deviation(points_cam: Points, nearest: NearestPoints) -> PerPoint:
    """Return the distance to the neighbours' robust plane, in radii of the neighbourhood."""
    steps = (points_cam[nearest] - points_cam[:, None]).double()
    radius = steps[..., :2].norm(dim=-1).median(dim=1).values.clamp_min(1e-12)
    scaled = steps / radius[:, None, None]
    design = torch.cat([scaled[..., :2], torch.ones_like(scaled[..., :1])], dim=-1)
    ridge = 1e-3 * torch.eye(3, dtype=design.dtype, device=design.device)
    weight = 1 / (1 + scaled[..., 2].square())  # starts from neighbours on the same side
    for _ in range(5):  # re-weighted: a neighbour across a depth edge must not tilt the plane
        normal = (weight[..., None] * design).mT @ design + ridge
        rhs = ((weight * scaled[..., 2])[..., None] * design).sum(dim=1)
        plane = torch.linalg.solve(normal, rhs)
        residual = (scaled[..., 2] - (design @ plane[..., None])[..., 0]).abs()
        weight = 1 / (1 + (residual / (residual.median(dim=1).values[:, None] + 0.02)) ** 2)
    return plane[:, 2].abs().to(points_cam.dtype)


def delaunay(pixels: Pixels) -> Faces:
    """Return a Delaunay triangulation of points of an image, front faces to the camera."""
    simplices = Delaunay(pixels.detach().cpu().double().numpy()).simplices
    faces = torch.from_numpy(simplices.astype(np.int64)).to(pixels.device)
    corners = pixels[faces]
    rotated = torch.linalg.det(corners[:, 1:] - corners[:, :1]) > 0
    return torch.where(rotated[:, None], faces.flip(1), faces)


def facets_under(pixels: Pixels, corners_px: Float[Tensor, "face 3 2"]) -> Int[Tensor, " point"]:
    """Return the facet that contains each point of an image, -1 outside all."""
    facets = []
    size = max(1, 2_000_000 // max(1, len(corners_px)))  # some 100 MB
    for batch in torch.split(pixels, size):
        within = (barycentric_2d(batch[:, None], corners_px[None]) >= 0).all(dim=-1)
        facet = within.to(torch.int8).argmax(dim=1)
        facets.append(torch.where(within.any(dim=1), facet, -1))
    return torch.cat(facets)
