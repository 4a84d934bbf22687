"""Checks of a given mesh against the points and masks of a scene."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.local_frame import from_local
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Mesh, Silhouettes, SparseScene
from pimper_torch.runtime.errors import InputError, caution

# Maximum number of rays to points, and of rays along the longer side of a photograph.
_MAX_RAYS, _SIDE = 4000, 64
# A point within this fraction of the mesh's diagonal is on it: rough meshes are off by as much.
_NEAR = 0.03

Rows = Float[Tensor, "ray 3"]


def compare_with_scene(
    mesh: Mesh, scene: SparseScene, silhouettes: Silhouettes
) -> dict[str, int | float]:
    """Measure how well a mesh fits the points and masks of a scene; warn if it is off.

    An observed point is neither behind the mesh nor in front of it: the ray to it hits the mesh at
    the point or, if the point is background, nowhere.

    Args:
        silhouettes: Compared if they are masks given with the photographs.

    Returns:
        Available figures: median distance of points with rays that hit the mesh, in per cent of its
        diagonal; fraction of these points on it; overlap with the masks; number of these rays.

    Raises:
        InputError: Hardly any agreement with points and masks.
    """
    fit = _fit(mesh, *_rays(scene, silhouettes))
    frame = "in the coordinate frame of the cameras (same axes, same unit)"
    # Even the bounding box of an object is off by less than a tenth of its diagonal.
    if fit.score < 0.1 and not fit.distance < 0.1:
        raise InputError(
            f"The given mesh is not where the photographs show the object: {fit.message()}. It must"
            f" be {frame}: give its sparse model with `--sparse`, or align the mesh first."
        )
    unknown = math.isnan(fit.score) and fit.rays >= 30
    if unknown or fit.distance > 0.02 or fit.score < 0.8 or fit.overlap < 0.8:
        caution(
            f"The given mesh deviates from the photographs: {fit.message()}. Check that it is "
            f"{frame} and shows this object."
        )
    names = ("distance_percent", "on_mesh", "overlap", "observations")
    figures = zip(names, (100 * fit.distance, fit.on_mesh, fit.overlap, fit.hits), strict=True)
    return {name: value for name, value in figures if not math.isnan(value)}


def refuse_other_axes(mesh: Mesh, scene: SparseScene) -> None:
    """Raise InputError if a mesh fits camera-to-world or OpenGL poses but not the given poses."""
    cameras = scene.cameras
    poses = cameras.cam_from_world.detach().double()
    given = from_local(poses, scene.offset_world)  # wrong poses may be why there is an offset
    inverse, flip = torch.linalg.inv(given), poses.new_tensor([1.0, -1, -1, 1]).diag()
    used = mesh.vertices_world.detach()[mesh.faces.flatten()][:: 1 + mesh.faces.numel() // 1000]
    others = {
        "torch.linalg.inv(poses)": (inverse, "camera-to-world"),
        "flip @ poses": (flip @ given, "for cameras with y up and z backward"),
        "flip @ torch.linalg.inv(poses)": (flip @ inverse, "camera-to-world, y up, z backward"),
    }

    def count_views(poses: Tensor) -> int:
        pixels, depth = project(used.to(poses), poses, cameras.intrinsics.detach().to(poses))
        sizes = cameras.sizes_px[:, None]
        visible = (depth > 0) & (pixels >= 0).all(dim=-1) & (pixels < sizes).all(dim=-1)
        return int((visible.double().mean(dim=1) > 0.5).sum())

    num_views = count_views(poses)
    for code, (other, convention) in others.items():
        count = count_views(other)
        if count >= 0.9 * len(poses) and num_views < 0.5 * count:
            raise InputError(
                f"The given mesh is in {num_views} of {len(poses)} photographs with the given "
                f"poses, but in {count} with `{code}`"
                f"{', where `flip = diag(1, -1, -1, 1)`' * ('flip' in code)}: the poses seem to be "
                f"{convention}; needed: cam_from_world, x right, y down, z forward."
            )


class _Fit(NamedTuple):
    """Agreement of a mesh with points and masks; NaN where it cannot be measured.

    Attributes:
        rays: Number of rays to observed points.
        hits: Number of these rays that hit the mesh.
        on_mesh: Fraction of the hits with their point on the mesh.
        overlap: Intersection over union of its silhouettes and the masks.
        distance: Median distance of the hits' points, in diagonals.
        diagonal: Of the mesh, scene units.
    """

    rays: int
    hits: int
    on_mesh: float
    overlap: float
    distance: float
    diagonal: float

    @property
    def score(self) -> float:
        """Mean of the measured fractions, so masks can outweigh a poor cloud."""
        values = [value for value in (self.on_mesh, self.overlap) if not math.isnan(value)]
        return sum(values) / len(values) if values else math.nan

    def message(self) -> str:
        """Return the agreement as clauses of a sentence."""
        parts = [f"rays to {self.hits} of {self.rays} observed points hit it"]
        if not math.isnan(self.on_mesh):
            parts = [
                f"{self.on_mesh:.0%} of {self.hits} observed points whose rays hit it are on it, "
                f"their median distance is {100 * self.distance:.2g}% of the diagonal "
                f"({self.distance * self.diagonal:.3g})"
            ]
        if not math.isnan(self.overlap):
            parts.append(f"its silhouettes overlap with the masks by {self.overlap:.0%}")
        return ", and ".join(parts)


def _fit(mesh: Mesh, origins: Rows, directions: Rows, inside: Bool[Tensor, " pixel"]) -> _Fit:
    """Measure the agreement of a mesh with the rays of :func:`_rays`."""
    count = len(origins) - len(inside)
    used = mesh.vertices_world[mesh.faces.flatten()].double()
    diagonal = float((used.amax(dim=0) - used.amin(dim=0)).norm())
    cast = RayCaster(mesh.vertices_world, mesh.faces).cast(origins, directions)
    hit, length = cast.face >= 0, directions.norm(dim=1)
    # The ray's length limits the tolerance: a mesh around the cameras does not fit.
    near = (cast.distance.double() - 1).abs() * length <= _NEAR * length.clamp_max(diagonal)
    at_points, at_pixels = hit[:count], hit[count:]
    hits = int(at_points.sum())
    distance = on_mesh = overlap = math.nan
    if hits:
        points = (origins + directions)[:count][at_points]
        distance = float(NearestSurface(mesh).query(points).distance.median()) / diagonal
    if hits >= min(30, max(1, count // 4)):  # fewer are not significant
        on_mesh = int((near[:count] & at_points).sum()) / hits
    if len(inside):
        overlap = int((at_pixels & inside).sum()) / max(1, int((at_pixels | inside).sum()))
    return _Fit(count, hits, on_mesh, overlap, distance, diagonal)


def _rays(
    scene: SparseScene, silhouettes: Silhouettes
) -> tuple[Rows, Rows, Bool[Tensor, " pixel"]]:
    """Return rays to observed points, then through a raster of pixels of every mask.

    Returns:
        Origins; directions, as long as the distance to the points; and whether pixels are inside
        the mask. With masks, only points observed inside them are used.
    """
    cameras, masked = scene.cameras, silhouettes.source == "masks"
    masks = silhouettes.inside > 0.5
    step = -(-len(scene.observation_point) // _MAX_RAYS) or 1
    point, view = scene.observation_point[::step], scene.observation_view[::step]
    if masked:
        height, width = masks.shape[-2:]
        column, row = scene.observation_pixels[::step].floor().long().unbind(dim=-1)
        inside_mask = masks[view, row.clamp(0, height - 1), column.clamp(0, width - 1)]
        point, view = point[inside_mask], view[inside_mask]
    centers, poses = cameras.centers_world.detach().double(), cameras.cam_from_world.detach()
    to_points = scene.points_world[point].detach().double() - centers[view]
    rays, inside = [(centers[view], to_points)], [masks.new_zeros(0)]
    for number in range(cameras.num_views if masked else 0):
        width, height = (int(side) for side in cameras.sizes_px[number])
        step = -(-max(width, height) // _SIDE)
        raster = slice(step // 2, None, step)
        mask = masks[number, :height, :width][raster, raster].flatten()
        # A mask of nearly all pixels has no silhouette.
        if bool(silhouettes.reliable[number]) and float(mask.float().mean()) <= 0.95:
            pose, K = poses[number].double(), cameras.intrinsics[number].detach().double()
            pixels = pixel_centers(width, height, like=pose)[raster, raster].reshape(-1, 2)
            through = rays_through(pixels, pose, K)
            rays.append((centers[number].expand_as(through), through))
            inside.append(mask)
    origins, directions = (torch.cat(part).cpu() for part in zip(*rays, strict=True))
    return origins, directions, torch.cat(inside).cpu()
