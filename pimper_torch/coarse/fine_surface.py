"""The coarse surface: points where there is texture, contours at silhouettes, smooth between."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.coarse.cropping import cropped
from pimper_torch.coarse.densify import DensifyConfig
from pimper_torch.coarse.matched import matched_cloud, pixel_size_at
from pimper_torch.coarse.matching import level_of
from pimper_torch.coarse.oriented import OrientedPoints, joined_points, no_points
from pimper_torch.coarse.trim import (
    Terms,
    enclosed_holes,
    fringes,
    hanging_together,
    point_distances,
    supported_pieces,
    terms,
    too_far,
    without_small_holes,
)
from pimper_torch.config import require
from pimper_torch.errors import ReconstructionError
from pimper_torch.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, ContourPoints, Record, SparseScene, Support
from pimper_torch.sfm.surfaces import poisson_surface
from pimper_torch.silhouettes.contours import Contours

# Barycentric coordinates of the places that tell what supports a facet.
_PLACES = ((4, 1, 1), (1, 4, 1), (1, 1, 4), (2, 2, 2))

# Cosine between a surface's normal and the ray to a camera, above which it faces that.
_FACING = 0.1

# Points that make a surface, with contours or without.
_MIN_POINTS = 16

# Views that see something behind a face which is a lid; that show a lit one lit.
_DENYING, _LIGHTING = 2, 2

# Without silhouettes: pixels from all points, beyond which seen faces without any go, and with them
# what hangs together with them further than the second from all points.
_GAP_PX, _BRINK_PX = 40.0, 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FineSurfaceConfig:
    """How points and contours become a surface.

    Lengths in pixels are those of the finest depth maps, at the cloud's median depth.

    Attributes:
        point_px: Of the cloud's finest grid.
        cell_px: Of the surface's octree.
        max_depth: Of the octree, whatever the cell.
        touches: How often the places are found where contours touch the surface, each time on the
            surface before; the first time on the points.
        tolerance_px: By which points and surface may lie outside the visual hull.
        reach_px: A face nearer to a point, or a contour point, than this is supported by it.
        hole_px: Side of a square as large as the largest hole that is closed whatever made it.
            Strips along a border that are narrower go, where they are small or unsupported.
        max_unseen: Fraction of the area seen that a hole may have which only lack of views made,
            such as the bottom of a deep concavity, to be closed.
        min_fraction: Of the area that points or contours support, which a piece apart has to have.
    """

    point_px: float = 1.0
    cell_px: float = 4.0
    max_depth: int = 10
    touches: int = 3
    tolerance_px: float = 4.0
    reach_px: float = 4.0
    hole_px: float = 24.0
    max_unseen: float = 0.02
    min_fraction: float = 0.01

    def __post_init__(self) -> None:
        name = "fine_surface"
        require(self.cell_px > 0, f"{name}.cell_px", self.cell_px, "above 0")
        require(2 <= self.max_depth <= 12, f"{name}.max_depth", self.max_depth, "2 to 12")
        require(self.touches >= 1, f"{name}.touches", self.touches, "1 or more")
        require(self.tolerance_px >= 0, f"{name}.tolerance_px", self.tolerance_px, "0 or more")
        require(self.point_px > 0, f"{name}.point_px", self.point_px, "above 0")
        require(self.reach_px > 0, f"{name}.reach_px", self.reach_px, "above 0")
        require(0 <= self.min_fraction < 1, f"{name}.min_share", self.min_fraction, "in [0, 1)")
        require(self.hole_px >= 0, f"{name}.hole_px", self.hole_px, "0 or more")
        require(0 <= self.max_unseen < 1, f"{name}.max_unseen", self.max_unseen, "in [0, 1)")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FineSurface(Record):
    """The surface before it is simplified to facets.

    Attributes:
        vertices_world: Its vertices.
        faces: Its faces.
        support: What supports each, see :class:`~pimper_torch.records.Support`.
        pixel: Size of one of the finest depth maps there, scene units.
    """

    vertices_world: Float[Tensor, "vertex 3"]
    faces: Int[Tensor, "face 3"]
    support: Int[Tensor, " face"]
    pixel: float

    def support_of(self, corners: Float[Tensor, "facet 3 3"]) -> Int[Tensor, " facet"]:
        """Give facets the support that most of their places have on this surface."""
        centre = self.vertices_world[self.faces].mean(dim=1)
        weights = corners.new_tensor(_PLACES) / 6
        places = torch.einsum("pk,fkc->fpc", weights, corners).flatten(0, 1)
        tree = cKDTree(centre.detach().cpu().numpy())
        _, nearest = tree.query(places.detach().cpu().numpy())
        found = self.support[torch.from_numpy(nearest).to(self.support.device)]
        return found.reshape(len(corners), len(_PLACES)).mode(dim=1).values


def fine_surface(
    scene: SparseScene,
    reliable: Int[Tensor, " reliable"],
    contours: Contours,
    densify: DensifyConfig,
    config: FineSurfaceConfig,
) -> FineSurface:
    """Put a surface through matched points and contours, smooth where there are neither.

    Args:
        scene: Photographs, cameras and cloud.
        reliable: Points of the cloud inside the visual hull; an object without texture has none.
        contours: What silhouettes say about the surface.
        densify: How photographs are matched.
        config: Settings.

    Returns:
        What a view sees of the closed surface, inside the silhouettes. It is closed except where
        nothing was photographed, and where views look into an opening. Where silhouettes leave
        nothing out, faces without points have to be near to some, and to show something in two
        views.

    Raises:
        ReconstructionError: Silhouettes and photographs tell of no surface.
    """
    part = cropped(scene, contours.silhouettes)
    centre = contours.hull.corners_world.mean(dim=0).to(scene.points_world)
    cloud, maps = no_points(centre), None
    if len(reliable) >= _MIN_POINTS or not contours.confine:
        found, maps, pixel = matched_cloud(part, reliable, densify, config.point_px)
        cloud = found.take(
            contours.hull.depth_of(found.points_world) > -config.tolerance_px * pixel
        )
        level = maps.level
    else:
        factor = densify.factors(max(part.views.images.shape[-2:]))[-1]
        pixel, level = factor * pixel_size_at(centre, scene.cameras), level_of(part, factor)
    vertices, faces, contour = closed_surface(cloud, contours, pixel, config)
    said = terms(vertices, faces, level, maps)
    centres = vertices[faces].mean(dim=1)
    support = supports(centres, cloud, contour, said, config.reach_px * pixel)
    if contours.confine:
        inside = contours.hull.holds(centres, config.tolerance_px * pixel)
    else:
        inside = near_points(faces, centres, cloud, support, said, pixel)
    kept = seen_surface(vertices, faces, support, said, inside, pixel, config)
    if not bool(kept.any()):
        raise ReconstructionError(
            f"coarse mesh: none of {len(faces)} faces is seen by the photographs inside the "
            "silhouettes. Look at the masks, leave them out, or bring a mesh of your own."
        )
    used, faces = torch.unique(faces[kept], return_inverse=True)
    return FineSurface(
        vertices_world=vertices[used], faces=faces, support=support[kept], pixel=pixel
    )


def closed_surface(
    cloud: OrientedPoints, contours: Contours, pixel: float, config: FineSurfaceConfig
) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"], ContourPoints]:
    """Put a closed surface through points, tangent to the rays through the silhouettes.

    Where each ray touches it follows from the surface, and the surface from where rays touch
    it: they are found in turn, from the points on. Parts that no camera sees tell nothing: behind
    an object seen from one side the hull is deep, and the surface fills it.

    Args:
        cloud: Matched points inside the silhouettes.
        contours: Rays and visual hull of the same silhouettes.
        pixel: Size of one, scene units.
        config: Settings.

    Returns:
        Vertices, faces, and the contour points that the surface goes through.

    Raises:
        ReconstructionError: Too few of both.
    """
    places, normals = cloud.points_world, cloud.normals_world
    for _ in range(config.touches):
        touched = contours.touching(places, normals)
        contour = OrientedPoints(
            points_world=touched.points_world.to(cloud.points_world),
            normals_world=touched.normals_world.to(cloud.points_world),
            noise=touched.variance.sqrt().to(cloud.noise),
        )
        if len(cloud.points_world) + len(touched.ray) < _MIN_POINTS:
            raise ReconstructionError(
                f"coarse mesh: {len(cloud.points_world)} points were matched inside the "
                f"silhouettes, and {len(touched.ray)} rays touch the surface there; some hundreds "
                "are needed. Take photographs that overlap more, look at the masks, or bring a "
                "mesh of your own."
            )
        # Points alone know more than contours: an octree's cell is as wide as two of their grid.
        cell = (config.cell_px if len(touched.ray) else 2 * config.point_px) * pixel
        vertices, faces = poisson(joined_points(cloud, contour), cell, config.max_depth)
        if not len(touched.ray):
            break
        normals = vertex_normals(vertices, faces)
        front = shown(vertices, faces, normals, contours.cameras, config.cell_px * pixel)
        places, normals = vertices[front], normals[front]
    return vertices, faces, touched


def shown(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    normals: Float[Tensor, "vertex 3"],
    cameras: Cameras,
    tolerance: float,
) -> Bool[Tensor, " vertex"]:
    """Mark the vertices that face a camera and are not hidden from it.

    Args:
        vertices: Of a surface.
        faces: Of it.
        normals: Of its vertices.
        cameras: That look at it.
        tolerance: A surface closer than this in front of a vertex does not hide it.
    """
    caster, found = RayCaster(vertices, faces), torch.zeros_like(vertices[:, 0], dtype=torch.bool)
    for center in cameras.centers_world.to(vertices):
        towards = normalize(center - vertices, dim=1)
        asked = ((towards * normals).sum(dim=1) > _FACING) & ~found
        found[asked] = ~caster.occluded(vertices[asked], center, tolerance)
    return found


def poisson(
    cloud: OrientedPoints, cell: float, max_depth: int
) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Put a closed surface through points.

    Args:
        cloud: Points with outward normals.
        cell: Side of the octree's cells, scene units.
        max_depth: Of the octree, whatever the cell.
    """
    points = cloud.points_world
    # COLMAP works in single precision: a cloud far from the origin is brought there.
    centre = points.median(dim=0).values
    extent = float((points.amax(dim=0) - points.amin(dim=0)).max())
    cells = extent / cell
    depth = min(max_depth, round(math.log2(cells)))
    vertices, faces = poisson_surface(
        points - centre, cloud.normals_world, depth=depth, point_weight=1.0
    )
    return vertices.to(points) + centre, faces.to(points.device)


def near_points(
    faces: Int[Tensor, "face 3"],
    centre: Float[Tensor, "face 3"],
    cloud: OrientedPoints,
    support: Int[Tensor, " face"],
    said: Terms,
    pixel: float,
) -> Bool[Tensor, " face"]:
    """Mark faces with points, and those between points that views see and that are near to some.

    Args:
        faces: Of the closed surface.
        centre: Of them.
        cloud: Matched points.
        support: Of each face.
        said: What the photographs say about each.
        pixel: Size of one, scene units.
    """
    supported = support == Support.POINTS
    distance = point_distances(centre, cloud.points_world)
    between = (said.lit >= _LIGHTING) & (said.denied < _DENYING) & ~supported
    far = too_far(faces, between, distance, _GAP_PX * pixel, _BRINK_PX * pixel)
    return (supported & (said.seen >= _LIGHTING)) | (between & ~far)


def supports(
    centre: Float[Tensor, "face 3"],
    cloud: OrientedPoints,
    contour: ContourPoints,
    said: Terms,
    reach: float,
) -> Int[Tensor, " face"]:
    """Tell what supports each face of a fine surface.

    Args:
        centre: Of the faces.
        cloud: Matched points.
        contour: TraceContours points.
        said: What the photographs say about the faces.
        reach: Distance to a point, or a contour point, that supports a face.
    """
    found = torch.full_like(said.seen, Support.NOTHING)
    found[said.lit >= _LIGHTING] = Support.LIGHT
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
    said: Terms,
    inside: Bool[Tensor, " face"],
    pixel: float,
    config: FineSurfaceConfig,
) -> Bool[Tensor, " face"]:
    """Mark the faces that stay: what a view sees, points and contours, in the visual hull.

    A lid goes: a face without points behind which views see something. What no view sees stays
    where it is a small hole in the rest; the back of an object seen from one side is a large one.
    The border has no fringes.

    Args:
        vertices: Of the closed surface.
        faces: Of it.
        support: Of each face.
        said: What the photographs say about each.
        inside: True for faces in the visual hull.
        pixel: Size of one, scene units.
        config: Settings.
    """
    known = support >= Support.CONTOUR
    small = (config.hole_px * pixel) ** 2
    possible = inside & ((said.denied < _DENYING) | (support == Support.POINTS))
    possible = without_small_holes(vertices, faces, possible, small)
    kept = possible & ((said.seen > 0) | known)
    area = float(face_normals(vertices, faces[kept]).norm(dim=1).sum()) / 2
    holes = enclosed_holes(vertices, faces, kept, config.max_unseen * area)
    kept = kept | (holes & ~hanging_together(faces, ~kept, ~possible))
    kept = without_small_holes(vertices, faces, kept, small)
    rings = int(config.hole_px / (2 * config.cell_px))
    kept &= ~fringes(vertices, faces, kept, support != Support.NOTHING, small, rings)
    (chosen,) = torch.nonzero(kept, as_tuple=True)
    pieces = supported_pieces(vertices, faces[chosen], known[chosen], config.min_fraction)
    kept[chosen[~pieces]] = False
    return kept
