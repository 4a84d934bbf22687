"""The coarse surface: through points and contours, smooth between them."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.pixels import crop_intrinsics
from pimper_torch.geometry.poisson import poisson_surface
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import (
    ContourPoints,
    OrientedPoints,
    Record,
    Silhouettes,
    SparseScene,
    Support,
)
from pimper_torch.records.shapes import Faces, Vertices
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import by_view, each, zeros
from pimper_torch.runtime.memory import emptied_on_release
from pimper_torch.stages.coarse import oriented, trim
from pimper_torch.stages.coarse.densify import DepthMaps, factors
from pimper_torch.stages.coarse.window_matching import MatchingLevel, level_of
from pimper_torch.store import digest

# In pixels of the finest depth maps, at the cloud's median depth. Largest distance of points and
# surface outside the visual hull; largest distance of a face to the points or contour points that
# support it. Choices of the surface through points and contours (rims) in benchmarks/README.md.
TOLERANCE_PX, REACH_PX = 4.0, 4.0

# Barycentric coordinates, times 6, of the points in a facet that vote for its support.
_VOTES = ((4, 1, 1), (1, 4, 1), (1, 1, 4), (2, 2, 2))


# What was matched, by a hash of the inputs: points from light need the surface a second time.
_matches: dict[str | None, tuple[OrientedPoints, DepthMaps | None, MatchingLevel, float]] = {}
emptied_on_release(_matches.clear)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FineSurface(Record):
    """The surface before it is simplified to facets.

    Attributes:
        support: Value of :class:`~pimper_torch.records.Support` of each face.
        pixel: Size of a pixel of the finest depth maps on the surface, scene units.
    """

    vertices_world: Vertices
    faces: Faces
    support: Int[Tensor, " face"]
    pixel: float

    def support_of(self, corners: Float[Tensor, "facet 3 3"]) -> Int[Tensor, " facet"]:
        """Return the support of each facet: the most frequent of the faces nearest to it."""
        centre = self.vertices_world[self.faces].mean(dim=1)
        points = torch.einsum("pk,fkc->fpc", corners.new_tensor(_VOTES) / 6, corners)
        tree = cKDTree(centre.detach().cpu().numpy())
        _, nearest = tree.query(points.flatten(0, 1).detach().cpu().numpy())
        votes = self.support[torch.from_numpy(nearest).to(self.support.device)]
        return votes.reshape(len(corners), len(_VOTES)).mode(dim=1).values


def fine_surface(
    scene: SparseScene,
    reliable: Int[Tensor, " reliable"],
    contours: Contours,
    levels: int,
    more: OrientedPoints | None = None,
) -> FineSurface:
    """Compute a surface through matched points and contours, smooth where there are neither.

    It is closed except where no view sees it, and where views look into an opening. If silhouettes
    constrain nothing, faces without points must be near points and illuminated in two views.

    Args:
        reliable: Points of the cloud inside the visual hull; an object without texture has none.
        contours: Rays and visual hull of the silhouettes.
        levels: Number of resolutions of the depth maps.
        more: See :class:`~pimper_torch.stages.coarse.surface.CoarseSurface`.

    Raises:
        ReconstructionError: Silhouettes and photographs support no surface.
    """
    if (key := digest(scene, reliable, contours, levels)) not in _matches:
        _matches[key] = _matched(scene, reliable, contours, levels)
    cloud, maps, level, pixel = _matches[key] if key else _matches.pop(key)
    if more is not None:
        cloud = OrientedPoints.cat([cloud, oriented.grid_averaged(more, pixel)])
    vertices, faces, contour = closed_surface(cloud, contours, pixel)
    reach = REACH_PX * pixel
    counts = trim.view_counts(vertices, faces, level, maps, cloud.points_world, reach)
    centres = vertices[faces].mean(dim=1)
    support = trim.supports(centres, cloud, contour, counts, reach)
    inside = contours.hull.holds(centres, TOLERANCE_PX * pixel)
    leave_out("coarse.outside", ~inside, at=centres)
    if not contours.confine:
        near = trim.near_points(faces, centres, cloud, support, counts, pixel)
        leave_out("coarse.far", inside & ~near, at=centres)
        inside &= near
    # Points from light cover all of the visible surface: components without any float in the air.
    least = Support.CONTOUR if more is None else Support.POINTS
    fraction = trim.min_fraction(contours)
    kept = trim.seen_surface(vertices, faces, support, counts, inside, pixel, fraction, least)
    if not bool(kept.any()):
        raise ReconstructionError(
            f"coarse mesh: no photograph sees any of {len(faces)} faces inside the silhouettes. "
            "Check the masks, omit them, or give a mesh."
        )
    used, faces = torch.unique(faces[kept], return_inverse=True)
    return FineSurface(
        vertices_world=vertices[used], faces=faces, support=support[kept], pixel=pixel
    )


def _matched(
    scene: SparseScene, reliable: Int[Tensor, " reliable"], contours: Contours, levels: int
) -> tuple[OrientedPoints, DepthMaps | None, MatchingLevel, float]:
    """Return matched points in the hull, depth maps and their level, and the size of a pixel.

    An object without texture has no points and no depth maps.
    """
    crop = cropped(scene, contours.silhouettes)
    if len(reliable) >= 16 or not contours.confine:
        matched, maps, pixel = oriented.matched_cloud(crop, reliable, levels)
        near = contours.hull.depth_of(matched.points_world) > -TOLERANCE_PX * pixel
        leave_out("coarse.matched", ~near, at=matched.points_world)
        return matched.take(near), maps, maps.level, pixel
    centre = contours.hull.corners_world.mean(dim=0).to(scene.points_world)
    factor = factors(max(crop.views.images.shape[-2:]), levels)[-1]
    distance = (scene.cameras.centers_world - centre).norm(dim=1)
    pixel = factor * float((distance / scene.cameras.intrinsics[:, 0, 0]).median())
    return oriented.no_points(centre), None, level_of(crop, factor), pixel


def closed_surface(
    cloud: OrientedPoints, contours: Contours, pixel: float
) -> tuple[Vertices, Faces, ContourPoints]:
    """Compute a closed surface through points, tangent to the rays through the silhouettes.

    Contour points follow from the surface, and the surface from the contour points: they are
    computed in turn, starting from the points. Surface that no camera sees is ignored, because
    the surface fills the deep hull behind an object seen from one side.

    Returns:
        Vertices, faces, and the contour points on the surface.
    """
    points, normals = cloud.points_world, cloud.normals_world
    # Contour points are first near the points, then near the surface of the previous iteration.
    for _ in range(3):
        touched = contours.touching(points, normals)
        contour = OrientedPoints(
            points_world=touched.points_world.to(cloud.points_world),
            normals_world=touched.normals_world.to(cloud.points_world),
            noise=touched.variance.sqrt().to(cloud.noise),
        )
        if len(cloud.points_world) + len(touched.ray) < 16:
            raise ReconstructionError(
                f"coarse mesh: {len(cloud.points_world)} points were matched inside the "
                f"silhouettes, and {len(touched.ray)} rays touch the surface there; some hundreds "
                "are needed. Take photographs that overlap more, check the masks, or give a mesh."
            )
        # Points are denser than contours: without contours, an octree cell is two of their cells.
        cell = (trim.CELL_PX if len(touched.ray) else 2.0) * pixel
        vertices, faces = poisson(OrientedPoints.cat([cloud, contour]), cell)
        if not len(touched.ray):
            break
        normals = vertex_normals(vertices, faces)
        caster, front = RayCaster(vertices, faces), torch.zeros_like(normals[:, 0]) > 0
        for center in contours.cameras.centers_world.to(vertices):
            towards = normalize(center - vertices, dim=1)
            facing = ((towards * normals).sum(dim=1) > 0.1) & ~front
            # Surface less than a cell in front of a vertex does not occlude it.
            front[facing] = ~caster.occluded(vertices[facing], center, trim.CELL_PX * pixel)
        points, normals = vertices[front], normals[front]
    return vertices, faces, touched


def poisson(cloud: OrientedPoints, cell: float) -> tuple[Vertices, Faces]:
    """Return vertices and faces of a closed surface through points with outward normals.

    Args:
        cell: Side of the octree's cells, scene units.
    """
    points = cloud.points_world
    # COLMAP works in single precision: the cloud is moved to the origin.
    centre = points.median(dim=0).values
    extent = float((points.amax(dim=0) - points.amin(dim=0)).max())
    # At most 1024 cells along a side, which bounds the octree's memory.
    depth = min(10, round(math.log2(extent / cell)))
    vertices, faces = poisson_surface(
        points - centre, cloud.normals_world, depth=depth, point_weight=1.0
    )
    return vertices.to(points) + centre, faces.to(points.device)


def cropped(scene: SparseScene, silhouettes: Silhouettes) -> SparseScene:
    """Return the scene cropped to the silhouettes, with them and occluders as masks.

    The images share one size, that of the largest bounding box. Views without a silhouette keep
    their upper left corner, masked. Cameras are adjusted. Priors are removed: their maps cover full
    photographs. Observations keep their pixels, those of the photographs before undistortion.

    Args:
        silhouettes: Of all views; unreliable ones mask their photographs, too. If they constrain
            nothing, the scene is returned unchanged.
    """
    if silhouettes.source == "everything":
        return scene
    boxes = _boxes(silhouettes, scene.cameras.sizes_px)
    low = boxes[:, 0]
    size = boxes[:, 1] - low
    width, height = size.amax(dim=0).tolist()
    views, masks = scene.views, silhouettes.shown
    images = zeros(
        (*views.images.shape[:2], height, width), views.images.dtype, views.images.device
    )
    visible = zeros((views.num_views, height, width), torch.bool, images.device)
    leave_out("coarse.cropping", by_view(lambda inside, mask: inside & ~mask, views.inside, masks))
    intrinsics = scene.cameras.intrinsics.clone()
    for view, (image, mask) in enumerate(each(views.images, masks)):
        (left, top), (w, h) = low[view].tolist(), size[view].tolist()
        rows, columns = slice(top, top + h), slice(left, left + w)
        images[view, :, :h, :w] = image[:, rows, columns]
        visible[view, :h, :w] = mask[rows, columns]
        intrinsics[view] = crop_intrinsics(intrinsics[view], float(left), float(top))
    return scene.replace(
        views=views.replace(images=images, masks=visible, sizes_px=size, priors=()),
        cameras=scene.cameras.replace(intrinsics=intrinsics, sizes_px=size),
    )


def _boxes(silhouettes: Silhouettes, sizes_px: Int[Tensor, "view 2"]) -> Int[Tensor, "view 2 2"]:
    """Return the corners of the silhouettes' bounding boxes: inclusive, then exclusive."""
    masks = silhouettes.masks
    ends = []
    for axis in range(2):  # columns, then rows
        along = by_view(lambda mask, axis=axis: mask.any(dim=axis), masks)
        index = torch.arange(along.shape[1], device=along.device)
        first = torch.where(along, index, along.shape[1]).amin(dim=1) - 8
        last = torch.where(along, index, -1).amax(dim=1) + 9
        ends.append(torch.stack([first, last], dim=1))
    boxes = torch.stack(ends, dim=2)
    empty = ~along.any(dim=1)
    boxes = torch.where(empty[:, None, None], boxes.new_tensor([[0, 0], [1, 1]]), boxes)
    limit = sizes_px.to(boxes)[:, None]
    return torch.minimum(boxes.clamp_min(0), limit)
