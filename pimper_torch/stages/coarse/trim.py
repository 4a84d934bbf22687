"""Trimming of a closed surface to the faces that photographs, points or contours support."""

from dataclasses import dataclass
from functools import reduce

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry import surfaces, topology
from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.linalg.sums import total
from pimper_torch.records import ContourPoints, OrientedPoints, Record, Support
from pimper_torch.records.shapes import FaceMask, Faces, Points, Vertices
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.parallel import num_workers, side_by_side
from pimper_torch.stages.coarse.densify import DepthMaps
from pimper_torch.stages.coarse.window_matching import MatchingLevel

# Octree cell in pixels of the finest depth maps at the cloud's median depth. A choice.
CELL_PX = 4.0

# Side of a square with the area of the largest hole that is closed whatever its cause, in the same
# pixels. Narrower strips along a border are removed if they are small or unsupported.
HOLE_PX = 24.0

# Largest area, as a fraction of the area seen, of a hole that is closed if only lack of views made
# it, such as the bottom of a deep concavity.
MAX_UNSEEN = 0.02

# Least cosine between a face's normal and the ray to a camera for a view to count: at 84 degrees a
# face is a tenth as wide as it is long.
_FACING = 0.1

# Views that see something behind a face for it to be dropped: a single one may be wrong.
_MIN_BEHIND = 2

# If two views see through at least this fraction of a region, all of it is dropped: 0.56 of the lid
# over a mug's mouth, and at most 0.1 of regions without points that exist (mug, cow, jar).
_MIN_THROUGH = 0.25

# Without silhouettes, a face without points is dropped if it is further than the first from all
# points, with all connected to it that are further than the second. Spans over gaps in potatoes
# stay, and surface in the air next to the object is dropped (benchmarks/README.md, ablations).
_GAP_PX, _MARGIN_PX = 40.0, 10.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ViewCounts(Record):
    """Numbers of views per face.

    Attributes:
        seen: Views in which the face is unoccluded, within the image, and facing the camera.
        lit: Views among these in which its pixel is illuminated.
        behind: Views that see through the face: their depth map has a matched point behind it.
    """

    seen: Int[Tensor, " face"]
    lit: Int[Tensor, " face"]
    behind: Int[Tensor, " face"]


def view_counts(
    vertices: Vertices,
    faces: Faces,
    level: MatchingLevel,
    maps: DepthMaps | None,
    matched_world: Points,
    reach: float,
) -> ViewCounts:
    """Count the views that see the centre of each face, see it lit, and see through it.

    Depth maps without texture have errors: a depth counts only if near the cloud of all views.

    Args:
        level: Photographs, at the resolution of the depth maps.
        maps: Of all views; without them, no view sees through a face.
        matched_world: The cloud of all views.
        reach: Largest distance between this cloud and a depth that counts, scene units.
    """
    cameras = level.cameras
    centre = vertices[faces].mean(dim=1)
    normals = surfaces.unit_face_normals(vertices, faces)
    side = surfaces.side_lengths(vertices[faces]).amax(dim=1)
    caster, cloud = RayCaster(vertices, faces), cKDTree(matched_world.detach().cpu().numpy())

    def of_view(view: int) -> Int[Tensor, "count face"]:
        seen, lit, behind = torch.zeros_like(faces[:, 0]).expand(3, -1).clone()
        center = cameras.centers_world[view]
        pixels, depth = project(centre, cameras.cam_from_world[view], cameras.intrinsics[view])
        facing = (normalize(center - centre, dim=-1) * normals).sum(dim=-1) > _FACING
        within = ((pixels >= 0) & (pixels < cameras.sizes_px[view])).all(dim=1) & (depth > 0)
        (chosen,) = torch.nonzero(within & facing, as_tuple=True)
        column, row = pixels[chosen].floor().long().unbind(dim=-1)
        column = column.clamp_max(level.tone.shape[-1] - 1)
        row = row.clamp_max(level.tone.shape[-2] - 1)
        if maps is not None:
            # Depths that agree differ by a step at most, faces deviate from points by a few.
            nearest = maps.inverse_depth[view, row, column] + 4.0 * maps.step[view]
            through = maps.valid[view, row, column] & (1 / depth[chosen] > nearest)
            frame, intrinsics = cameras.cam_from_world[view], cameras.intrinsics[view]
            rays = rays_through(pixels[chosen][through], frame, intrinsics)
            inverse_depth = maps.inverse_depth[view, row, column][through, None]
            distance, _ = cloud.query((center + rays / inverse_depth).detach().cpu().numpy())
            behind[chosen[through]] = torch.from_numpy(distance <= reach).to(behind)
        free = ~caster.occluded(centre[chosen], center, 0.5 * side[chosen])
        free &= level.usable[view, row, column]
        seen[chosen] = free.long()
        # A twentieth of the 98th percentile of radiance, plus the hundredth that ``tone`` adds.
        lit[chosen] = (free & (level.tone[view, row, column] > 0.06**0.5)).long()
        return torch.stack([seen, lit, behind])

    counts = side_by_side(of_view, range(cameras.num_views), tracked=False)
    seen, lit, behind = reduce(torch.add, counts)
    return ViewCounts(seen=seen, lit=lit, behind=behind)


def point_distances(queries: Float[Tensor, "query 3"], points: Points) -> Float[Tensor, " query"]:
    """Return the distance of each query to the nearest point."""
    tree = cKDTree(points.detach().cpu().numpy())
    distance, _ = tree.query(queries.detach().cpu().numpy(), workers=num_workers())
    return torch.from_numpy(distance).to(queries)


def without_small_holes(
    vertices: Vertices, faces: Faces, kept: FaceMask, largest: float
) -> FaceMask:
    """Return the kept faces and components of the others of less area (scene units squared)."""
    areas = surfaces.component_areas(vertices, faces, topology.face_components(faces, ~kept))
    return kept | (~kept & (areas < largest))


def enclosed_holes(vertices: Vertices, faces: Faces, kept: FaceMask, largest: float) -> FaceMask:
    """Return the connected components of dropped faces, up to an area, that kept faces enclose.

    A component at the border of the surface is not enclosed.
    """
    label = topology.face_components(faces, ~kept)
    paired = torch.bincount(topology.face_pairs(faces)[0].flatten(), minlength=len(faces))
    on_border = torch.zeros_like(label).index_add(0, label, (paired < 3).long())
    areas = surfaces.component_areas(vertices, faces, label)
    return ~kept & (on_border[label] == 0) & (areas <= largest)


def supported_components(
    vertices: Vertices, faces: Faces, supported: FaceMask, fraction: float
) -> FaceMask:
    """Return the faces of components with at least a fraction of the total supported area."""
    same = torch.zeros_like(faces[:, 0])
    areas, total = (
        surfaces.component_areas(vertices, faces, label, supported)
        for label in (topology.face_components(faces), same)
    )
    return areas >= fraction * total


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
    support = torch.full_like(counts.seen, Support.NOTHING)
    support[counts.lit >= 2] = Support.LIGHT
    for points, kind in ((contour, Support.CONTOUR), (cloud, Support.POINTS)):
        if len(points.points_world):
            support[point_distances(centre, points.points_world) <= reach] = kind
    return support


def near_points(
    faces: Faces,
    centre: Float[Tensor, "face 3"],
    cloud: OrientedPoints,
    support: Int[Tensor, " face"],
    counts: ViewCounts,
    pixel: float,
) -> FaceMask:
    """Return faces with points, and illuminated faces near points.

    Illuminated faces beyond the margin from all points are excluded if their connected component
    has a face beyond the gap. Surface that spans a gap inside the object is joined to surface in
    the air next to it by strips along points, and the margin cuts through these.
    """
    supported = support == Support.POINTS
    distance = point_distances(centre, cloud.points_world)
    between = (counts.lit >= 2) & (counts.behind < _MIN_BEHIND) & ~supported
    beyond = between & (distance > _MARGIN_PX * pixel)
    far = topology.connected_to(faces, beyond, distance > _GAP_PX * pixel)
    return (supported & (counts.seen >= 2)) | (between & ~far)


def seen_surface(
    vertices: Vertices,
    faces: Faces,
    support: Int[Tensor, " face"],
    counts: ViewCounts,
    inside: FaceMask,
    pixel: float,
    fraction: float,
    least: Support = Support.CONTOUR,
) -> FaceMask:
    """Return the faces to keep: in the visual hull, and seen or supported.

    Surface without points that views see through closes an opening or floats in the air, and is
    dropped; a region is dropped completely if they see through enough of it. Faces that no view
    sees are kept if they close a small hole, unlike the back of an object seen from one side.

    Args:
        inside: True for faces in the visual hull.
        pixel: Size of a pixel of the finest depth maps on the surface, scene units.
        fraction: Least fraction of the supported area in a component that is kept.
        least: Least support of a face that counts as supported area.
    """
    matched = support >= Support.CONTOUR
    small = (HOLE_PX * pixel) ** 2
    bare = inside & (support != Support.POINTS)
    through = bare & (counts.behind >= _MIN_BEHIND)
    region = topology.face_components(faces, visible := bare & (counts.seen > 0))
    share = torch.bincount(region, through.double()) / torch.bincount(region)
    through |= visible & (share >= _MIN_THROUGH)[region]
    possible = without_small_holes(vertices, faces, inside & ~through, small)
    leave_out("coarse.seen_through", inside & ~possible, at=(vertices, faces))
    kept = possible & ((counts.seen > 0) | matched)
    leave_out("coarse.unseen", possible & ~kept, at=(vertices, faces))
    area = float(total(surfaces.face_normals(vertices, faces[kept]).norm(dim=1))) / 2
    holes = enclosed_holes(vertices, faces, kept, MAX_UNSEEN * area)
    kept = kept | (holes & ~topology.connected_to(faces, ~kept, ~possible))
    kept = without_small_holes(vertices, faces, kept, small)
    # Strips are narrow parts of the border, which a morphological opening removes.
    rings, count = int(HOLE_PX / (2 * CELL_PX)), len(vertices)
    core = ~topology.dilated(faces, ~kept, rings, count)
    strips = kept & ~topology.dilated(faces, core, rings, count)
    label = topology.face_components(faces, strips)
    areas = surfaces.component_areas(vertices, faces, label)
    supported = surfaces.component_areas(vertices, faces, label, support != Support.NOTHING)
    strips &= (areas < small) | (supported < areas / 2)
    leave_out("coarse.fringes", strips, at=(vertices, faces))
    kept &= ~strips
    (chosen,) = torch.nonzero(kept, as_tuple=True)
    large = supported_components(vertices, faces[chosen], support[chosen] >= least, fraction)
    leave_out("coarse.components", ~large, at=(vertices, faces[chosen]))
    kept[chosen[~large]] = False
    return kept


def min_fraction(contours: Contours) -> float:
    """Return the least fraction of the supported area in a component that is kept."""
    # Inside silhouettes, even a nearly hidden component belongs to the object: the rear one of six
    # balls is in two pieces of less than 0.01 each.
    return 0.002 if contours.confine else 0.01
