"""Whether a brought mesh is where points and masks show the object."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.ground.geometry.local_frame import from_local
from pimper_torch.ground.geometry.nearest import NearestSurface
from pimper_torch.ground.geometry.pixels import pixel_centers
from pimper_torch.ground.geometry.projection import project, rays_through
from pimper_torch.ground.geometry.visibility import RayCaster
from pimper_torch.records import Mesh, Silhouettes, SparseScene
from pimper_torch.runtime.errors import InputError, caution

# Maximum number of rays to points, and along a photograph's longer side.
_MAX_RAYS, _SIDE = 4000, 64
# A point is on the mesh within this fraction of its diagonal: rough meshes are off by as much.
_NEAR = 0.03

Rows = Float[Tensor, "ray 3"]


def compare_with_scene(
    mesh: Mesh, scene: SparseScene, silhouettes: Silhouettes
) -> dict[str, int | float]:
    """Compare a mesh with the points and masks of a scene; warn of one that is far off.

    A point that a camera saw is neither behind the mesh nor in front of it: rays to observed
    points meet the mesh at the point, or nowhere, as those to the background do.

    Args:
        silhouettes: Compared too where they are masks that came with the photographs.

    Returns:
        Figures, as far as they are known: median distance of points whose rays meet the mesh in per
        cent of its diagonal, the fraction of these on it, overlap with masks, number of such rays.
    """
    fit = _fit(mesh, *_rays(scene, silhouettes))
    frame = "in the frame of the cameras, with their axes and their unit"
    # The box around an object is off by less than a tenth of its diagonal.
    if fit.score < 0.1 and not fit.distance < 0.1:
        raise InputError(
            f"The given mesh is not where the photographs show the object: {fit.message()}. It has "
            f"to be {frame}: give the model that it belongs to by `--sparse`, or align it first."
        )
    unknown = math.isnan(fit.score) and fit.rays >= 30
    if unknown or fit.distance > 0.02 or fit.score < 0.8 or fit.overlap < 0.8:
        caution(
            f"The given mesh is off what the photographs show: {fit.message()}. Look whether it is "
            f"{frame}, and of this object."
        )
    figures = {
        "distance_percent": 100 * fit.distance,
        "on_mesh": fit.on_mesh,
        "overlap": fit.overlap,
        "observations": fit.hits,
    }
    return {name: value for name, value in figures.items() if not math.isnan(value)}


def refuse_other_axes(mesh: Mesh, scene: SparseScene) -> None:
    """Refuse poses that miss a mesh, where camera-to-world or cameras of OpenGL would show it."""
    cameras = scene.cameras
    poses = cameras.cam_from_world.detach().double()
    given = from_local(poses, scene.offset_world)  # where a scene is far off, it may be for this
    inverse, flip = torch.linalg.inv(given), poses.new_tensor([1.0, -1, -1, 1]).diag()
    used = mesh.vertices_world.detach()[mesh.faces.flatten()][:: 1 + mesh.faces.numel() // 1000]
    others = {
        "torch.linalg.inv(poses)": (inverse, "camera-to-world"),
        "flip @ poses": (flip @ given, "of cameras with y up and z backward"),
        "flip @ torch.linalg.inv(poses)": (flip @ inverse, "camera-to-world, y up, z backward"),
    }

    def showing(poses: Tensor) -> int:
        pixels, depth = project(used.to(poses), poses, cameras.intrinsics.detach().to(poses))
        sizes = cameras.sizes_px[:, None]
        shown = (depth > 0) & (pixels >= 0).all(dim=-1) & (pixels < sizes).all(dim=-1)
        return int((shown.double().mean(dim=1) > 0.5).sum())

    seen = showing(poses)
    for code, (other, what) in others.items():
        count = showing(other)
        if count >= 0.9 * len(poses) and seen < 0.5 * count:
            raise InputError(
                f"The given mesh is in {seen} of {len(poses)} photographs by their poses, but in "
                f"{count} by `{code}`{', with `flip = diag(1, -1, -1, 1)`' * ('flip' in code)}: "
                f"they seem to be {what}; needed: cam_from_world, x right, y down, z forward."
            )


class _Fit(NamedTuple):
    """Agreement of a mesh with photographs; NaN for what nothing shows.

    Attributes:
        hits: Of the rays to points, the ones that meet the mesh.
        on_mesh: Fraction of the hits whose point is on it.
        overlap: Of its silhouettes with the masks, intersection over union.
        distance: Median of the hits' points, in diagonals.
    """

    rays: int
    hits: int
    on_mesh: float
    overlap: float
    distance: float
    diagonal: float

    @property
    def score(self) -> float:
        """Mean of the fractions that are known: a poor cloud does not refuse what masks show."""
        known = [value for value in (self.on_mesh, self.overlap) if not math.isnan(value)]
        return sum(known) / len(known) if known else math.nan

    def message(self) -> str:
        """State how far off the mesh is, in a part of a sentence."""
        parts = [f"rays to {self.hits} of {self.rays} observed points meet it"]
        if not math.isnan(self.on_mesh):
            parts = [
                f"{self.on_mesh:.0%} of {self.hits} observed points whose rays meet it are on it, "
                f"their median distance is {100 * self.distance:.2g}% of the diagonal "
                f"({self.distance * self.diagonal:.3g})"
            ]
        if not math.isnan(self.overlap):
            parts.append(f"its silhouettes overlap with the masks by {self.overlap:.0%}")
        return ", and ".join(parts)


def _fit(mesh: Mesh, origins: Rows, directions: Rows, inside: Bool[Tensor, " pixel"]) -> _Fit:
    """Cast the rays of :func:`_rays`."""
    count = len(origins) - len(inside)
    used = mesh.vertices_world[mesh.faces.flatten()].double()
    diagonal = float((used.amax(dim=0) - used.amin(dim=0)).norm())
    cast = RayCaster(mesh.vertices_world, mesh.faces).cast(origins, directions)
    met, length = cast.face >= 0, directions.norm(dim=1)
    # Nothing is near in a mesh that the cameras are inside of.
    near = (cast.distance.double() - 1).abs() * length <= _NEAR * length.clamp_max(diagonal)
    reached, shown = met[:count], met[count:]
    hits = int(reached.sum())
    distance = on_mesh = overlap = math.nan
    if hits:
        points = (origins + directions)[:count][reached]
        distance = float(NearestSurface(mesh).query(points).distance.median()) / diagonal
    if hits >= min(30, max(1, count // 4)):  # fewer tell nothing
        on_mesh = int((near[:count] & reached).sum()) / hits
    if len(inside):
        overlap = int((shown & inside).sum()) / max(1, int((shown | inside).sum()))
    return _Fit(count, hits, on_mesh, overlap, distance, diagonal)


def _rays(
    scene: SparseScene, silhouettes: Silhouettes
) -> tuple[Rows, Rows, Bool[Tensor, " pixel"]]:
    """Return rays to observed points, then through a raster of pixels of every mask.

    Returns:
        Origins; directions, which reach from them to the points; and whether pixels are inside the
        mask. With masks, points are those on the object.
    """
    cameras, masked = scene.cameras, silhouettes.source == "masks"
    masks = silhouettes.inside > 0.5
    step = -(-len(scene.observation_point) // _MAX_RAYS) or 1
    point, view = scene.observation_point[::step], scene.observation_view[::step]
    if masked:
        height, width = masks.shape[-2:]
        column, row = scene.observation_pixels[::step].floor().long().unbind(dim=-1)
        drawn = masks[view, row.clamp(0, height - 1), column.clamp(0, width - 1)]
        point, view = point[drawn], view[drawn]
    centers, poses = cameras.centers_world.detach().double(), cameras.cam_from_world.detach()
    to_points = scene.points_world[point].detach().double() - centers[view]
    rays, inside = [(centers[view], to_points)], [masks.new_zeros(0)]
    for number in range(cameras.num_views if masked else 0):
        width, height = (int(side) for side in cameras.sizes_px[number])
        step = -(-max(width, height) // _SIDE)
        raster = slice(step // 2, None, step)
        mask = masks[number, :height, :width][raster, raster].flatten()
        # A mask of nearly everything shows no silhouette.
        if bool(silhouettes.reliable[number]) and float(mask.float().mean()) <= 0.95:
            pose, K = poses[number].double(), cameras.intrinsics[number].detach().double()
            pixels = pixel_centers(width, height, like=pose)[raster, raster].reshape(-1, 2)
            through = rays_through(pixels, pose, K)
            rays.append((centers[number].expand_as(through), through))
            inside.append(mask)
    origins, directions = (torch.cat(part).cpu() for part in zip(*rays, strict=True))
    return origins, directions, torch.cat(inside).cpu()
