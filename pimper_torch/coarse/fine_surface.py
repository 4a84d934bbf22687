"""The coarse surface: points where there is texture, contours at silhouettes, smooth between."""

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.coarse.densify import DensifyConfig
from pimper_torch.coarse.matched import matched_cloud, pixel_size_at
from pimper_torch.coarse.oriented import OrientedPoints, no_points
from pimper_torch.coarse.trim import (
    ViewCounts,
    enclosed_holes,
    fringes,
    point_distances,
    supported_components,
    view_counts,
    without_small_holes,
)
from pimper_torch.coarse.window_matching import level_of
from pimper_torch.config import Range, require_ranges
from pimper_torch.errors import ReconstructionError
from pimper_torch.geometry.pixels import crop_intrinsics
from pimper_torch.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.geometry.topology import connected_to, face_components
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.ledger import leave_out
from pimper_torch.linalg.sums import total
from pimper_torch.mapped import by_view, each, zeros
from pimper_torch.records import Cameras, ContourPoints, Record, Silhouettes, SparseScene, Support
from pimper_torch.sfm.colmap_surfaces import poisson_surface
from pimper_torch.silhouettes.contours import Contours

# Lengths in pixels are those of the finest depth maps, at the cloud's median depth. Choices,
# those of the surface through points and contours (rims) that benchmarks/README.md measures:
# the finest grid of the cloud; the octree's cell; how far points and surface may lie outside the
# visual hull; how near a face is to the points or contour points that support it.
POINT_PX, CELL_PX, TOLERANCE_PX, REACH_PX = 1.0, 4.0, 4.0, 4.0

# Of the octree, whatever the cell: 1024 cells along a side bound its memory.
MAX_DEPTH = 10

# How often contour points are found, each time on the surface before; the first time on the points.
_ITERATIONS = 3

# A component needs this fraction of the area that points or contours support: a choice where
# silhouettes constrain nothing. Inside them even what others nearly hide is the object's: of six
# balls, the one behind the others is in two pieces of less than 0.01 each.
_MIN_FRACTION, _MIN_FRACTION_INSIDE = 0.01, 0.002

# Barycentric coordinates, times 6, of the points of a facet that vote for its support.
_VOTES = ((4, 1, 1), (1, 4, 1), (1, 1, 4), (2, 2, 2))

# Cosine between a surface's normal and the ray to a camera, above which it faces that. A choice.
_FACING = 0.1

# Points and contour points that a surface can be put through, at least. A choice.
_MIN_POINTS = 16

# Views that see something behind a face which is dropped; that see an illuminated one lit: one view
# may be wrong.
_MIN_BEHIND, _MIN_LIT = 2, 2

# Fraction of a region that views see through, from which all of it is in the air: by two views,
# 0.56 of the lid over a mug's mouth, and at most 0.1 of regions without points that are there (mug,
# cow, jar); by one, 0.32 of a lump before potatoes, and 0.03 of pieces that are there.
_MOST_THROUGH = 0.25

# Without silhouettes a face without points is dropped where it is further than the first from all
# points, with all connected to it that are further than the second. Spans over gaps in potatoes
# stay, and surface in the air beside the object is dropped (benchmarks/README.md, ablations).
_GAP_PX, _MARGIN_PX = 40.0, 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FineSurfaceConfig:
    """Which holes of the surface are closed.

    Attributes:
        hole_px: Side of a square as large as the largest hole that is closed whatever made it,
            pixels of the finest depth maps. Strips along a border that are narrower go, where
            they are small or unsupported.
        max_unseen: Fraction of the area seen that a hole may have which only lack of views made,
            such as the bottom of a deep concavity, to be closed.
    """

    hole_px: Annotated[float, Range(least=0)] = 24.0
    max_unseen: Annotated[float, Range(least=0, below=1)] = 0.02

    def __post_init__(self) -> None:
        require_ranges(self, "fine_surface")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FineSurface(Record):
    """The surface before it is simplified to facets.

    Attributes:
        support: Of each, a value of :class:`~pimper_torch.records.Support`.
        pixel: Size of a pixel of the finest depth maps there, scene units.
    """

    vertices_world: Float[Tensor, "vertex 3"]
    faces: Int[Tensor, "face 3"]
    support: Int[Tensor, " face"]
    pixel: float

    def support_of(self, corners: Float[Tensor, "facet 3 3"]) -> Int[Tensor, " facet"]:
        """Assign facets the support that this surface has nearest to most of their points."""
        centre = self.vertices_world[self.faces].mean(dim=1)
        points = torch.einsum("pk,fkc->fpc", corners.new_tensor(_VOTES) / 6, corners)
        tree = cKDTree(centre.detach().cpu().numpy())
        _, nearest = tree.query(points.flatten(0, 1).detach().cpu().numpy())
        found = self.support[torch.from_numpy(nearest).to(self.support.device)]
        return found.reshape(len(corners), len(_VOTES)).mode(dim=1).values


def fine_surface(
    scene: SparseScene,
    reliable: Int[Tensor, " reliable"],
    contours: Contours,
    densify: DensifyConfig,
    config: FineSurfaceConfig,
) -> FineSurface:
    """Put a surface through matched points and contours, smooth where there are neither.

    It is closed except where no view sees it, and where views look into an opening. Where
    silhouettes constrain nothing, faces without points have to be near to some, and
    illuminated in two views.

    Args:
        reliable: Points of the cloud inside the visual hull; an object without texture has none.
        contours: Rays and visual hull of the silhouettes.

    Raises:
        ReconstructionError: Silhouettes and photographs support no surface.
    """
    part = cropped(scene, contours.silhouettes)
    centre = contours.hull.corners_world.mean(dim=0).to(scene.points_world)
    cloud, maps = no_points(centre), None
    if len(reliable) >= _MIN_POINTS or not contours.confine:
        found, maps, pixel = matched_cloud(part, reliable, densify, POINT_PX)
        near = contours.hull.depth_of(found.points_world) > -TOLERANCE_PX * pixel
        leave_out("coarse.matched", ~near, at=found.points_world)
        cloud = found.take(near)
        level = maps.level
    else:
        factor = densify.factors(max(part.views.images.shape[-2:]))[-1]
        pixel, level = factor * pixel_size_at(centre, scene.cameras), level_of(part, factor)
    vertices, faces, contour = closed_surface(cloud, contours, pixel)
    reach = REACH_PX * pixel
    counts = view_counts(vertices, faces, level, maps, cloud.points_world, reach)
    centres = vertices[faces].mean(dim=1)
    support = supports(centres, cloud, contour, counts, reach)
    inside = contours.hull.holds(centres, TOLERANCE_PX * pixel)
    leave_out("coarse.outside", ~inside, at=centres)
    if not contours.confine:
        near = near_points(faces, centres, cloud, support, counts, pixel)
        leave_out("coarse.far", inside & ~near, at=centres)
        inside &= near
    fraction = min_fraction(contours)
    kept = seen_surface(vertices, faces, support, counts, inside, pixel, config, fraction)
    if not bool(kept.any()):
        raise ReconstructionError(
            f"coarse mesh: none of {len(faces)} faces is seen by the photographs inside the "
            "silhouettes. Look at the masks, leave them out, or give a mesh of your own."
        )
    used, faces = torch.unique(faces[kept], return_inverse=True)
    return FineSurface(
        vertices_world=vertices[used], faces=faces, support=support[kept], pixel=pixel
    )


def min_fraction(contours: Contours) -> float:
    """Return the fraction of the supported area that a component needs."""
    return _MIN_FRACTION_INSIDE if contours.confine else _MIN_FRACTION


def closed_surface(
    cloud: OrientedPoints, contours: Contours, pixel: float
) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"], ContourPoints]:
    """Put a closed surface through points, tangent to the rays through the silhouettes.

    Where each ray touches it follows from the surface, and the surface from where rays touch
    it: they are found in turn, from the points on. Parts that no camera sees do not count:
    behind an object seen from one side the hull is deep, and the surface fills it.

    Returns:
        Vertices, faces, and the contour points that the surface goes through.

    Raises:
        ReconstructionError: Too few of both.
    """
    points, normals = cloud.points_world, cloud.normals_world
    for _ in range(_ITERATIONS):
        touched = contours.touching(points, normals)
        contour = OrientedPoints(
            points_world=touched.points_world.to(cloud.points_world),
            normals_world=touched.normals_world.to(cloud.points_world),
            noise=touched.variance.sqrt().to(cloud.noise),
        )
        if len(cloud.points_world) + len(touched.ray) < _MIN_POINTS:
            raise ReconstructionError(
                f"coarse mesh: {len(cloud.points_world)} points were matched inside the "
                f"silhouettes, and {len(touched.ray)} rays touch the surface there; some hundreds "
                "are needed. Take photographs that overlap more, look at the masks, or give a "
                "mesh of your own."
            )
        # Points are denser than contours: without these an octree's cell is two of their grid.
        cell = (CELL_PX if len(touched.ray) else 2 * POINT_PX) * pixel
        vertices, faces = poisson(OrientedPoints.cat([cloud, contour]), cell)
        if not len(touched.ray):
            break
        normals = vertex_normals(vertices, faces)
        front = visible_vertices(vertices, faces, normals, contours.cameras, CELL_PX * pixel)
        points, normals = vertices[front], normals[front]
    return vertices, faces, touched


def visible_vertices(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    normals: Float[Tensor, "vertex 3"],
    cameras: Cameras,
    tolerance: float,
) -> Bool[Tensor, " vertex"]:
    """Find the vertices that face a camera and are not occluded.

    Args:
        tolerance: A surface closer than this in front of a vertex does not occlude it.
    """
    caster, found = RayCaster(vertices, faces), torch.zeros_like(vertices[:, 0], dtype=torch.bool)
    for center in cameras.centers_world.to(vertices):
        towards = normalize(center - vertices, dim=1)
        facing = ((towards * normals).sum(dim=1) > _FACING) & ~found
        found[facing] = ~caster.occluded(vertices[facing], center, tolerance)
    return found


def poisson(
    cloud: OrientedPoints, cell: float
) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Put a closed surface through points with outward normals.

    Args:
        cell: Side of the octree's cells, scene units.
    """
    points = cloud.points_world
    # COLMAP works in single precision: a cloud far from the origin is brought there.
    centre = points.median(dim=0).values
    extent = float((points.amax(dim=0) - points.amin(dim=0)).max())
    depth = min(MAX_DEPTH, round(math.log2(extent / cell)))
    vertices, faces = poisson_surface(
        points - centre, cloud.normals_world, depth=depth, point_weight=1.0
    )
    return vertices.to(points) + centre, faces.to(points.device)


def regions_seen_through(
    faces: Int[Tensor, "face 3"], some: Bool[Tensor, " face"], through: Bool[Tensor, " face"]
) -> Bool[Tensor, " face"]:
    """Find the connected regions of some faces that views see through over enough of them.

    Args:
        some: True for faces that make up the regions.
        through: True for faces that views see through.
    """
    (index,) = torch.nonzero(some, as_tuple=True)
    region = face_components(faces[index])
    share = torch.bincount(region, through[index].double()) / torch.bincount(region)
    return torch.zeros_like(some).index_put((index,), (share >= _MOST_THROUGH)[region])


def near_points(
    faces: Int[Tensor, "face 3"],
    centre: Float[Tensor, "face 3"],
    cloud: OrientedPoints,
    support: Int[Tensor, " face"],
    counts: ViewCounts,
    pixel: float,
) -> Bool[Tensor, " face"]:
    """Find faces with points, and illuminated faces between points that are near to some.

    A component of faces further than the margin from all points is not marked if one of them is
    further than the gap: surface that spans a gap inside the object is joined to surface in
    the air beside it by strips along points, which the margin cuts through.
    """
    supported = support == Support.POINTS
    distance = point_distances(centre, cloud.points_world)
    between = (counts.lit >= _MIN_LIT) & (counts.behind < _MIN_BEHIND) & ~supported
    beyond = between & (distance > _MARGIN_PX * pixel)
    far = connected_to(faces, beyond, distance > _GAP_PX * pixel)
    return (supported & (counts.seen >= _MIN_LIT)) | (between & ~far)


def supports(
    centre: Float[Tensor, "face 3"],
    cloud: OrientedPoints,
    contour: ContourPoints,
    counts: ViewCounts,
    reach: float,
) -> Int[Tensor, " face"]:
    """Return the :class:`~pimper_torch.records.Support` of each face of a fine surface.

    Args:
        reach: Distance to a point, or a contour point, that supports a face.
    """
    found = torch.full_like(counts.seen, Support.NOTHING)
    found[counts.lit >= _MIN_LIT] = Support.LIGHT
    for points, support in (
        (contour.points_world, Support.CONTOUR),
        (cloud.points_world, Support.POINTS),
    ):
        if len(points):
            found[point_distances(centre, points) <= reach] = support
    return found


def seen_surface(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    support: Int[Tensor, " face"],
    counts: ViewCounts,
    inside: Bool[Tensor, " face"],
    pixel: float,
    config: FineSurfaceConfig,
    fraction: float = _MIN_FRACTION,
) -> Bool[Tensor, " face"]:
    """Find the faces that stay: in the visual hull, and seen or supported.

    Surface without points that views see through is dropped: it closes an opening, or floats in
    the air, and all of it goes where they see through enough of it. Faces that no view sees stay
    where they close a small hole; the back of an object seen from one side is a large one. Narrow
    strips along the border are dropped.

    Args:
        inside: True for faces in the visual hull.
        fraction: Of the supported area, that a component needs.
    """
    known = support >= Support.CONTOUR
    small = (config.hole_px * pixel) ** 2
    bare = inside & (support != Support.POINTS)
    through = bare & (counts.behind >= _MIN_BEHIND)
    through |= regions_seen_through(faces, bare & (counts.seen > 0), through)
    possible = without_small_holes(vertices, faces, inside & ~through, small)
    leave_out("coarse.seen_through", inside & ~possible, at=(vertices, faces))
    kept = possible & ((counts.seen > 0) | known)
    leave_out("coarse.unseen", possible & ~kept, at=(vertices, faces))
    area = float(total(face_normals(vertices, faces[kept]).norm(dim=1))) / 2
    holes = enclosed_holes(vertices, faces, kept, config.max_unseen * area)
    kept = kept | (holes & ~connected_to(faces, ~kept, ~possible))
    kept = without_small_holes(vertices, faces, kept, small)
    rings = int(config.hole_px / (2 * CELL_PX))
    floating = regions_seen_through(faces, kept, bare & (counts.behind > 0))
    leave_out("coarse.floating", floating, at=(vertices, faces))
    kept &= ~floating
    strips = fringes(vertices, faces, kept, support != Support.NOTHING, small, rings)
    leave_out("coarse.fringes", strips, at=(vertices, faces))
    kept &= ~strips
    (chosen,) = torch.nonzero(kept, as_tuple=True)
    stays = supported_components(vertices, faces[chosen], known[chosen], fraction)
    leave_out("coarse.components", ~stays, at=(vertices, faces[chosen]))
    kept[chosen[~stays]] = False
    return kept


# Pixels kept round the silhouettes, for windows that reach beyond what they match. A choice.
_MARGIN = 8


def cropped(scene: SparseScene, silhouettes: Silhouettes) -> SparseScene:
    """Cut every photograph to its silhouette's bounding box, and mask it and what hides it.

    The photographs share one raster: the largest box's. Views without a silhouette keep their
    left upper corner, masked. Cameras follow; priors are left out, as their maps cover whole
    photographs; observations keep their pixels, which are those of the photographs before
    undistortion.

    Args:
        silhouettes: Of all views; unreliable ones mask their photographs too. Silhouettes that
            constrain nothing give the scene as it is.
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
    shown = zeros((views.num_views, height, width), torch.bool, images.device)
    leave_out("coarse.cropping", by_view(lambda one, mask: one & ~mask, views.inside, masks))
    intrinsics = scene.cameras.intrinsics.clone()
    for view, (image, mask) in enumerate(each(views.images, masks)):
        (left, top), (w, h) = low[view].tolist(), size[view].tolist()
        rows, columns = slice(top, top + h), slice(left, left + w)
        images[view, :, :h, :w] = image[:, rows, columns]
        shown[view, :h, :w] = mask[rows, columns]
        intrinsics[view] = crop_intrinsics(intrinsics[view], float(left), float(top))
    return scene.replace(
        views=views.replace(images=images, masks=shown, sizes_px=size, priors=()),
        cameras=scene.cameras.replace(intrinsics=intrinsics, sizes_px=size),
    )


def _boxes(silhouettes: Silhouettes, sizes_px: Int[Tensor, "view 2"]) -> Int[Tensor, "view 2 2"]:
    """Return the corners of boxes round the silhouettes, first inside, then outside."""
    masks = silhouettes.masks
    ends = []
    for axis in range(2):  # columns, then rows
        along = by_view(lambda mask, axis=axis: mask.any(dim=axis), masks)
        index = torch.arange(along.shape[1], device=along.device)
        first = torch.where(along, index, along.shape[1]).amin(dim=1) - _MARGIN
        last = torch.where(along, index, -1).amax(dim=1) + 1 + _MARGIN
        ends.append(torch.stack([first, last], dim=1))
    boxes = torch.stack(ends, dim=2)
    empty = ~along.any(dim=1)
    boxes = torch.where(empty[:, None, None], boxes.new_tensor([[0, 0], [1, 1]]), boxes)
    limit = sizes_px.to(boxes)[:, None]
    return torch.minimum(boxes.clamp_min(0), limit)
