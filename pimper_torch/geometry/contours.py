"""Constraints of the silhouettes on the surface: contour rays and contour points.

Points of the silhouettes become rays to which the surface is tangent, with its normal there. The
tangent point on a ray is computed from a previous estimate of the surface.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates
from scipy.spatial import cKDTree
from skimage.measure import find_contours
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.visual_hull import Hull, UnboundedHull
from pimper_torch.records import Cameras, ContourPoints, ContourRays, Record, Silhouettes
from pimper_torch.records.shapes import Map, Points
from pimper_torch.runtime.parallel import num_workers, side_by_side

Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]

# Variance of a position known to one pixel: that of the uniform distribution over it.
_PIXEL = 1 / 12

# Variance of measuring a slope: a difference over a pixel (1/12) of interpolated values (1/6).
_READING = 1 / 12 + 1 / 6


# Selection of the points that become rays; choices, in pixels of the probability maps.
_BLUR_PX = 1.0  # standard deviation of the Gaussian that smooths the maps
_TANGENT_PX = 3.0  # the same along the silhouette, for its tangents
_BORDER_PX = 3.0  # minimum distance of rays from the photograph's border
_MIN_LENGTH_PX = 24.0  # shorter silhouettes are specks
_CORNER_PX = 6  # a corner is a turn of the tangent between this far behind and this far ahead
_MAX_CONVEX_DEG = 90.0  # maximum turn where the silhouette bends around the object
# Maximum turn where it bends into the object: the silhouette has a concave corner, without a
# normal, at an occlusion of the surface by itself.
_MAX_CONCAVE_DEG = 40.0


def contour_rays(silhouettes: Silhouettes, cameras: Cameras, per_view: int = 300) -> ContourRays:
    r"""Compute rays through the silhouettes, with the surface normal on each.

    At its outline the surface is tangent to the ray, and its contour to the silhouette. The normal
    is :math:`\pm r \times \dot r`, with :math:`r` the ray and :math:`\dot r` its change along the
    silhouette (Cipolla & Blake, IJCV 9(2), 1992). The silhouette is where the smoothed probability
    is a half. As the distribution of the silhouette's position, the probability has a slope of
    :math:`1 / (\sigma \sqrt{2 \pi})` there.

    Args:
        silhouettes: Probabilities that pixels show the object; unreliable views get no rays.
        per_view: Approximate number of rays a view, evenly spaced, at least a pixel apart.

    Returns:
        Rays of all reliable views, except at corners, where the surface has no single normal, on
        specks, and at the photograph's border. Not differentiable.
    """

    def of_view(view: int) -> ContourRays:
        return _of_view(silhouettes.inside[view], cameras, view, per_view)

    views = silhouettes.reliable.nonzero()[:, 0].tolist()
    return ContourRays.cat([_no_rays(cameras), *side_by_side(of_view, views)])


def _no_rays(cameras: Cameras) -> ContourRays:
    empty = cameras.intrinsics.new_zeros(0, 3)
    return ContourRays(
        view=torch.zeros(0, dtype=torch.long, device=empty.device),
        pixels=empty[:, :2],
        rays_world=empty,
        normals_world=empty,
        sigma_px=empty[:, 0],
    )


@torch.no_grad()
def _of_view(inside: Map, cameras: Cameras, view: int, per_view: int) -> ContourRays:
    like, (width, height) = cameras.intrinsics, cameras.sizes_px[view].tolist()
    probability = inside[:height, :width].detach().cpu().double().numpy()
    smooth = gaussian_filter(probability, _BLUR_PX, mode="nearest")
    lines = [_resampled(line) for line in find_contours(smooth, 0.5)]
    lines = [(points, closed) for points, closed in lines if len(points) >= _MIN_LENGTH_PX]
    stride = max(1.0, sum(len(points) for points, _ in lines) / per_view)
    rows = [_samples(points, closed, smooth, stride) for points, closed in lines]
    table = torch.from_numpy(np.concatenate([np.zeros((0, 7)), *rows])).to(like)
    point, along, outward, slope = torch.split(table, [2, 2, 2, 1], dim=1)
    pixels = pixels_from_indices(point)
    frame, intrinsics = cameras.cam_from_world[view], cameras.intrinsics[view]
    rays = rays_through(pixels, frame, intrinsics)
    # Rays are affine in the pixel.
    across = torch.linalg.cross(rays, rays_through(pixels + along, frame, intrinsics) - rays)
    towards = rays_through(pixels + outward, frame, intrinsics) - rays
    side = (across * towards).sum(dim=1, keepdim=True).sign()
    added = _BLUR_PX**2 + _READING
    spread = 1 / (math.sqrt(2 * math.pi) * slope[:, 0])
    return ContourRays(
        view=torch.full_like(pixels[:, 0], view, dtype=torch.long),
        pixels=pixels,
        rays_world=rays,
        normals_world=normalize(side * across, dim=1),
        sigma_px=((spread.square() - added).clamp_min(0) + _PIXEL).sqrt(),
    )


def _resampled(corners: Array) -> tuple[Array, bool]:
    """Resample a line about a pixel apart; return points ``(u, v)`` and whether it is closed."""
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    closed = bool((corners[0] == corners[-1]).all())
    positions = np.linspace(0, length[-1], round(length[-1]), endpoint=not closed)
    points = [np.interp(positions, length, corners[:, axis]) for axis in (1, 0)]
    return np.stack(points, axis=1), closed


def _samples(points: Array, closed: bool, smooth: Array, stride: float) -> Array:
    """Return rows of position, tangent and outward direction, two numbers each, and slope."""
    mode: Literal["wrap", "nearest"] = "wrap" if closed else "nearest"
    tangent = gaussian_filter1d(points, _TANGENT_PX, axis=0, order=1, mode=mode)
    tangent = tangent / np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    # The probability falls outward; its slope is the difference over half a pixel on either side.
    across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    inner, outer = (
        map_coordinates(smooth, (points + shift * across).T[::-1], order=1, mode="nearest")
        for shift in (0.5, -0.5)
    )
    rise = inner - outer
    outward = -np.sign(rise)[:, None] * across
    behind, ahead = (
        np.take(tangent, np.arange(len(points)) + by, axis=0, mode="wrap" if closed else "clip")
        for by in (-_CORNER_PX, _CORNER_PX)
    )
    rotation = np.degrees(np.arccos((behind * ahead).sum(axis=1).clip(-1, 1)))
    convex = ((ahead - behind) * outward).sum(axis=1) < 0
    limit = np.where(convex, _MAX_CONVEX_DEG, _MAX_CONCAVE_DEG)
    size = np.array([smooth.shape[1], smooth.shape[0]]) - 1.0
    margin = np.minimum(points, size - points).min(axis=1) + 0.5
    good = (rotation <= limit) & (margin >= _BORDER_PX) & (rise != 0)
    chosen = np.arange(0, len(points), stride).astype(int)
    chosen = chosen[chosen < len(points)]  # rounding may add one
    chosen = chosen[good[chosen]]
    rows = np.concatenate([points, tangent, outward, np.abs(rise)[:, None]], axis=1)
    return np.asarray(rows[chosen])


# Minimum cosine between the normal of the nearest point's disc and the offset from it, for a
# position below the surface: no position is below it next to its boundary.
_ALONG_NORMAL = 0.9

# Distance outside the visual hull at which a ray may touch the surface.
_TOLERANCE_PX = 1.5

# A point's disc reaches to the last of this many nearest points, the neighbours in a triangle mesh.
_NEIGHBOURS = 7


@torch.no_grad()
def contour_points(
    rays: ContourRays, cameras: Cameras, hull: Hull, points_world: Points, normals_world: Points
) -> ContourPoints:
    """Find the tangent points of contour rays on a surface given by points with normals.

    A tangent point is the position inside the visual hull at which the ray is deepest below the
    surface or, if it misses the surface, nearest to it. An error along the ray matters little,
    because the surface is tangent to it.

    Args:
        points_world: Of the surface where it is known: a cloud, or the vertices of a mesh. Without
            points, the result is the centre of the ray's part inside the hull.

    Returns:
        At most one point a ray. Rays that miss the hull have none, nor have rays equally near to
        two surfaces, one behind the other, where parts occlude each other. Not differentiable.
    """
    centers = cameras.centers_world[rays.view]
    focal = cameras.intrinsics[rays.view, 0, 0]
    # Depths at which rays enter and leave the bounding sphere of the hull's grid.
    corners = hull.corners_world.to(rays.rays_world)
    middle, radius = corners.mean(dim=0), (corners[1] - corners[0]).norm() / 2
    square = rays.rays_world.square().sum(dim=1, keepdim=True)
    along = ((middle - centers) * rays.rays_world).sum(dim=1, keepdim=True) / square
    reach = radius / square.sqrt()
    low, high = (along - reach).clamp_min(0), (along + reach).clamp_min(0)
    steps = 128
    depth = low + torch.linspace(0, 1, steps).to(low) * (high - low)
    pixel = depth.mean(dim=1) / focal
    usable = len(points_world) > 0 and len(rays.view) > 0
    surface = _SignedDistance(points_world, normals_world) if usable else None
    cost = _costs(rays, centers, depth, hull, _TOLERANCE_PX * pixel, surface)
    clear = ~ambiguous(cost, 2.0 * pixel)
    (ray,) = torch.nonzero(cost.isfinite().any(dim=1) & clear, as_tuple=True)
    best = depth[ray].gather(1, cost[ray].argmin(dim=1, keepdim=True))
    offset = torch.linspace(-1, 1, 25).to(low)
    fine = best + offset * (high - low)[ray] / (steps - 1)
    tolerance = _TOLERANCE_PX * pixel[ray]
    cost = _costs(rays.take(ray), centers[ray], fine, hull, tolerance, surface)
    tangent = fine.gather(1, cost.argmin(dim=1, keepdim=True))
    sigma = rays.sigma_px[ray] * tangent[:, 0] / focal[ray]
    return ContourPoints(
        points_world=centers[ray] + tangent * rays.rays_world[ray],
        normals_world=rays.normals_world[ray],
        variance=sigma.square(),
        view=rays.view[ray],
        ray=ray,
    )


class _SignedDistance:
    """Signed distance to a surface given by points with normals, negative below it.

    Each point represents a disc in its tangent plane that reaches to its neighbours.
    """

    def __init__(self, points: Points, normals: Points) -> None:
        positions = points.detach().cpu().double().numpy()
        self._points, self._normals, self._tree = points, normals, cKDTree(positions)

    def __call__(self, positions: Float[Tensor, "place 3"]) -> Float[Tensor, " place"]:
        queries = positions.detach().cpu().double().numpy()
        _, nearest = self._tree.query(queries, workers=num_workers())
        index = torch.from_numpy(nearest).to(self._points.device)
        offset, normals = positions - self._points[index], self._normals[index]
        height = (offset * normals).sum(dim=1)
        used, disc = torch.unique(index, return_inverse=True)
        count = min(_NEIGHBOURS, len(self._points))
        centers = self._points[used].detach().cpu().double().numpy()
        reach, _ = self._tree.query(centers, k=[count], workers=num_workers())
        radii = torch.from_numpy(np.asarray(reach)[:, 0]).to(self._points)[disc]
        outside = (offset - height[:, None] * normals).norm(dim=1) - radii
        distance = torch.hypot(height, outside.clamp_min(0))
        return torch.where(height < -_ALONG_NORMAL * distance, -distance, distance)


def _costs(
    rays: ContourRays,
    centers: Float[Tensor, "ray 3"],
    depth: Float[Tensor, "ray step"],
    hull: Hull,
    tolerance: Float[Tensor, " ray"],
    surface: _SignedDistance | None,
) -> Float[Tensor, "ray step"]:
    """Return the signed distance to the surface along the rays; infinite outside the hull.

    Without a surface it is the distance to the centre of the ray's part inside the hull.
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
    """Return whether each ray is equally near to two surfaces, one behind the other.

    Args:
        cost: Signed distance to the surface along the rays; infinite where they cannot touch it.
        tolerance: Distances that differ by less are equal. Two near positions are on different
            surfaces if the distance exceeds the smallest one by twice this between them.
    """
    margin = tolerance[:, None]
    # Positions below the surface count as on it, so the thickness of a part does not matter.
    lowest = cost.amin(dim=1, keepdim=True).clamp_min(0)
    near, far = cost <= lowest + margin, cost > lowest + 2 * margin
    # Near positions in different stretches have a far one between them.
    stretch = far.cumsum(dim=1)
    first = torch.where(near, stretch, cost.shape[1] + 1).amin(dim=1)
    last = torch.where(near, stretch, -1).amax(dim=1)
    return last > first


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Contours(Record):
    """Contour rays, to which the surface is tangent, and the visual hull that contains it.

    Attributes:
        rays: Through the silhouettes of all reliable views.
    """

    silhouettes: Silhouettes
    rays: ContourRays
    cameras: Cameras
    hull: Hull

    @classmethod
    def none(cls, silhouettes: Silhouettes, cameras: Cameras) -> "Contours":
        """Return contours without rays; the hull is all space, or all space above the planes."""
        like, planes = cameras.cam_from_world, silhouettes.planes_world
        hull = UnboundedHull(
            origin_world=like.new_zeros(3),
            spacing=like.new_ones(()),
            distance=like.new_full((1, 1, 1), torch.inf),
            normals_world=planes[:, :3].to(like),
            offsets=-planes[:, 3].to(like),
        )
        return cls(silhouettes=silhouettes, rays=_no_rays(cameras), cameras=cameras, hull=hull)

    @property
    def confine(self) -> bool:
        """Whether the hull is bounded by silhouettes."""
        return not isinstance(self.hull, UnboundedHull)

    def touching(self, points_world: Points, normals_world: Points) -> ContourPoints:
        """Return the tangent points of the rays on a surface; see :func:`.contour_points`."""
        return contour_points(self.rays, self.cameras, self.hull, points_world, normals_world)

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage."""
        return {"contour_rays": len(self.rays.view)}
