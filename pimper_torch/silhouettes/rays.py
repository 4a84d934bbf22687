"""Contour rays: pixels of the silhouettes as rays that the surface is tangent to."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates
from skimage.measure import find_contours
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.config import Range, require_ranges
from pimper_torch.failures import solved_or
from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.geometry.projection import rays_through
from pimper_torch.parallel import side_by_side
from pimper_torch.records import Cameras, ContourRays, Silhouettes

Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]

# Variance of a place that is known to a pixel: that of the uniform distribution over it.
_PIXEL = 1 / 12

# Variance that reading a slope between pixels adds: a difference over one pixel (1/12) of
# values interpolated linearly (1/6).
_READING = 1 / 12 + 1 / 6


@dataclass(frozen=True, slots=True, kw_only=True)
class RayConfig:
    """Which points of the silhouettes become rays.

    Lengths are in pixels of the probability maps.

    Attributes:
        per_view: About so many rays a view, evenly spaced, at least a pixel apart.
        blur_px: Standard deviation of the Gaussian that the maps are smoothed with.
        tangent_px: The same along the silhouette, for its tangents.
        corner_px: A corner is where the tangent turns too far from so far before to so far
            after it.
        max_convex_deg: Turn of a silhouette that bends round the object, at most.
        max_concave_deg: The same of one that bends into it: where one part of the surface
            hides another, the silhouette has a concave corner, and no normal.
        border_px: Rays keep so far from the photograph's border.
        min_length_px: Shorter silhouettes are specks.
    """

    per_view: Annotated[int, Range(least=1, most=1_000_000)] = 300
    blur_px: Annotated[float, Range(above=0, most=65_535)] = 1.0
    tangent_px: Annotated[float, Range(above=0, most=65_535)] = 3.0
    corner_px: Annotated[float, Range(least=1, most=65_535)] = 6.0
    max_convex_deg: Annotated[float, Range(above=0, most=180)] = 90.0
    max_concave_deg: Annotated[float, Range(above=0, most=180)] = 40.0
    border_px: Annotated[float, Range(least=0, most=65_535)] = 3.0
    min_length_px: Annotated[float, Range(least=0, most=65_535)] = 24.0

    def __post_init__(self) -> None:
        require_ranges(self, "contours")


def contour_rays(
    silhouettes: Silhouettes, cameras: Cameras, config: RayConfig | None = None
) -> ContourRays:
    r"""Cast rays through the silhouettes, and tell the surface's normal on each.

    A surface that ends in the picture is tangent there to the ray, and its contour to the
    silhouette: its normal is :math:`\pm r \times \dot r`, with :math:`r` the ray and
    :math:`\dot r` its change along the silhouette (Cipolla & Blake, IJCV 9(2), 1992). Silhouettes
    are where the smoothed probability is a half; read as the distribution of the silhouette's
    place, it has there a slope of :math:`1 / (\sigma \sqrt{2 \pi})`.

    Args:
        silhouettes: Probabilities that pixels show the object; views that are not reliable get
            no rays.

    Returns:
        Rays of all reliable views. Corners, where the surface has no single normal, specks,
        and what lies at the photograph's border have none. A constant to autograd.
    """
    config = config or RayConfig()

    def of_view(view: int) -> ContourRays:
        return solved_or(
            lambda: _of_view(silhouettes.inside[view], cameras, view, config),
            lambda: _nothing(cameras),
            stage="contours",
            name=f"contours of view {view}",
            done="The surface is found without these contours",
        )

    views = silhouettes.reliable.nonzero()[:, 0].tolist()
    return ContourRays.cat([_nothing(cameras), *side_by_side(of_view, views)])


def _nothing(cameras: Cameras) -> ContourRays:
    none = cameras.intrinsics.new_zeros(0, 3)
    return ContourRays(
        view=torch.zeros(0, dtype=torch.long, device=none.device),
        pixels=none[:, :2],
        rays_world=none,
        normals_world=none,
        sigma_px=none[:, 0],
    )


@torch.no_grad()
def _of_view(
    inside: Float[Tensor, "height width"], cameras: Cameras, view: int, config: RayConfig
) -> ContourRays:
    like, (width, height) = cameras.intrinsics, cameras.sizes_px[view].tolist()
    smooth = gaussian_filter(
        inside[:height, :width].detach().cpu().double().numpy(), config.blur_px, mode="nearest"
    )
    lines = [_resampled(line) for line in find_contours(smooth, 0.5)]
    lines = [line for line in lines if len(line.points) >= config.min_length_px]
    stride = max(1.0, sum(len(line.points) for line in lines) / config.per_view)
    rows = [_samples(line, smooth, stride, config) for line in lines]
    table = torch.from_numpy(np.concatenate([np.zeros((0, 7)), *rows])).to(like)
    point, along, outward, slope = torch.split(table, [2, 2, 2, 1], dim=1)
    pixels = pixels_from_indices(point)
    frame, intrinsics = cameras.cam_from_world[view], cameras.intrinsics[view]
    rays = rays_through(pixels, frame, intrinsics)
    # Rays are affine in the pixel.
    across = torch.linalg.cross(rays, rays_through(pixels + along, frame, intrinsics) - rays)
    towards = rays_through(pixels + outward, frame, intrinsics) - rays
    side = (across * towards).sum(dim=1, keepdim=True).sign()
    added = config.blur_px**2 + _READING
    spread = 1 / (math.sqrt(2 * math.pi) * slope[:, 0])
    return ContourRays(
        view=torch.full_like(pixels[:, 0], view, dtype=torch.long),
        pixels=pixels,
        rays_world=rays,
        normals_world=normalize(side * across, dim=1),
        sigma_px=((spread.square() - added).clamp_min(0) + _PIXEL).sqrt(),
    )


@dataclass(frozen=True, slots=True)
class _Line:
    """A silhouette's points ``(u, v)``, about a pixel apart, that count from 0."""

    points: Array
    closed: bool

    def shifted(self, values: Array, by: int) -> Array:
        """Return what stands so many points further along; the end's beyond an open one's end."""
        at = np.arange(len(values)) + by
        at = at % len(values) if self.closed else at.clip(0, len(values) - 1)
        shifted: Array = values[at]
        return shifted


def _resampled(corners: Array) -> _Line:
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    closed = bool((corners[0] == corners[-1]).all())
    wanted = np.linspace(0, length[-1], round(length[-1]), endpoint=not closed)
    points = [np.interp(wanted, length, corners[:, axis]) for axis in (1, 0)]
    return _Line(np.stack(points, axis=1), closed)


def _samples(line: _Line, smooth: Array, stride: float, config: RayConfig) -> Array:
    """Return rows of place, tangent and outward direction, two numbers each, and slope."""
    points = line.points
    how: Literal["wrap", "nearest"] = "wrap" if line.closed else "nearest"
    tangent = _unit(gaussian_filter1d(points, config.tangent_px, axis=0, order=1, mode=how))
    # The probability falls outward; half a pixel to either side tells how fast.
    across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    rise = _read(smooth, points + 0.5 * across) - _read(smooth, points - 0.5 * across)
    outward = -np.sign(rise)[:, None] * across
    reach = round(config.corner_px)
    behind, ahead = line.shifted(tangent, -reach), line.shifted(tangent, reach)
    rotation = np.degrees(np.arccos((behind * ahead).sum(axis=1).clip(-1, 1)))
    convex = ((ahead - behind) * outward).sum(axis=1) < 0
    most = np.where(convex, config.max_convex_deg, config.max_concave_deg)
    size = np.array([smooth.shape[1], smooth.shape[0]]) - 1.0
    margin = np.minimum(points, size - points).min(axis=1) + 0.5
    good = (rotation <= most) & (margin >= config.border_px) & (rise != 0)
    chosen = np.arange(0, len(points), stride).astype(int)
    chosen = chosen[chosen < len(points)]  # rounding may add one
    chosen = chosen[good[chosen]]
    rows = np.concatenate([points, tangent, outward, np.abs(rise)[:, None]], axis=1)
    return np.asarray(rows[chosen])


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _read(values: Array, points: Array) -> Array:
    return np.asarray(map_coordinates(values, points.T[::-1], order=1, mode="nearest"))
