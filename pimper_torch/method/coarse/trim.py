"""Which faces of a closed surface stay: those that photographs, points or contours support."""

from dataclasses import dataclass
from functools import reduce

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry import surfaces, topology
from pimper_torch.ground.geometry.contours import Contours
from pimper_torch.ground.geometry.projection import project, rays_through
from pimper_torch.ground.geometry.visibility import RayCaster
from pimper_torch.ground.linalg.sums import total
from pimper_torch.ground.shapes import FaceMask, Faces, Points, Vertices
from pimper_torch.method.coarse.densify import DepthMaps
from pimper_torch.method.coarse.window_matching import MatchingLevel
from pimper_torch.records import ContourPoints, OrientedPoints, Record, Support
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.parallel import num_workers, side_by_side

# Of the surface's octree, pixels of the finest depth maps at the cloud's median depth. A choice.
CELL_PX = 4.0

# Side of a square as large as the largest hole that is closed whatever made it, in those pixels.
# Strips along a border that are narrower go, where they are small or unsupported.
HOLE_PX = 24.0

# Fraction of the area seen up to which a hole is closed that only lack of views made, such as the
# bottom of a deep concavity.
MAX_UNSEEN = 0.02

# Cosine between a face's normal and the ray to a camera, above which a view counts: at 84 degrees a
# face is a tenth as wide as it is long.
_FACING = 0.1

# Views that see something behind a face which is dropped: one may be wrong.
_MIN_BEHIND = 2

# Fraction of a region that two views see through, from which all of it is in the air: 0.56 of the
# lid over a mug's mouth, and at most 0.1 of regions without points that are there (mug, cow, jar).
_MOST_THROUGH = 0.25

# Without silhouettes a face without points is dropped where it is further than the first from all
# points, with all connected to it that are further than the second. Spans over gaps in potatoes
# stay, and surface in the air beside the object is dropped (benchmarks/README.md, ablations).
_GAP_PX, _MARGIN_PX = 40.0, 10.0


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ViewCounts(Record):
    """Numbers of views, one of each a face.

    Attributes:
        seen: In which the face is unoccluded, within the picture, and facing.
        lit: In which, of these, its pixel is illuminated.
        behind: Whose depth map shows a matched point behind the face: they look through it.
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

    Depth maps of surface without texture are wrong in places, for single views: a depth counts only
    where it meets the cloud that all views have in common.

    Args:
        level: Photographs, at the resolution of the depth maps.
        maps: Of all views; without, none sees through a face.
        reach: Distance from these up to which a depth map meets them, scene units.
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
            # Depths that agree differ by a step at most, faces lie off points by some.
            nearest = maps.inverse_depth[view, row, column] + 4.0 * maps.step[view]
            through = maps.valid[view, row, column] & (1 / depth[chosen] > nearest)
            frame, intrinsics = cameras.cam_from_world[view], cameras.intrinsics[view]
            rays = rays_through(pixels[chosen][through], frame, intrinsics)
            shown = maps.inverse_depth[view, row, column][through, None]
            distance, _ = cloud.query((center + rays / shown).detach().cpu().numpy())
            behind[chosen[through]] = torch.from_numpy(distance <= reach).to(behind)
        free = ~caster.occluded(centre[chosen], center, 0.5 * side[chosen])
        free &= level.usable[view, row, column]
        seen[chosen] = free.long()
        # A twentieth of the bright level's radiance, above the pedestal of a hundredth.
        lit[chosen] = (free & (level.tone[view, row, column] > 0.06**0.5)).long()
        return torch.stack([seen, lit, behind])

    counts = side_by_side(of_view, range(cameras.num_views), tracked=False)
    seen, lit, behind = reduce(torch.add, counts)
    return ViewCounts(seen=seen, lit=lit, behind=behind)


def point_distances(queries: Float[Tensor, "query 3"], points: Points) -> Float[Tensor, " query"]:
    """Measure the distance of each query to the nearest point."""
    tree = cKDTree(points.detach().cpu().numpy())
    distance, _ = tree.query(queries.detach().cpu().numpy(), workers=num_workers())
    return torch.from_numpy(distance).to(queries)


def without_small_holes(
    vertices: Vertices, faces: Faces, kept: FaceMask, largest: float
) -> FaceMask:
    """Keep connected components of dropped faces too whose area is small, in scene units."""
    areas = surfaces.component_areas(vertices, faces, topology.face_components(faces, ~kept))
    return kept | (~kept & (areas < largest))


def enclosed_holes(vertices: Vertices, faces: Faces, kept: FaceMask, largest: float) -> FaceMask:
    """Find connected components of dropped faces, up to an area, that kept faces enclose.

    A component that reaches the border of the surface is not enclosed.
    """
    label = topology.face_components(faces, ~kept)
    paired = torch.bincount(topology.face_pairs(faces)[0].flatten(), minlength=len(faces))
    on_border = torch.zeros_like(label).index_add(0, label, (paired < 3).long())
    areas = surfaces.component_areas(vertices, faces, label)
    return ~kept & (on_border[label] == 0) & (areas <= largest)


def supported_components(
    vertices: Vertices, faces: Faces, supported: FaceMask, fraction: float
) -> FaceMask:
    """Find components with at least a fraction of the supported area of all."""
    everything = torch.zeros_like(faces[:, 0])
    own, total = (
        surfaces.component_areas(vertices, faces, label, supported)
        for label in (topology.face_components(faces), everything)
    )
    return own >= fraction * total


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
    found[counts.lit >= 2] = Support.LIGHT
    for points, support in (
        (contour.points_world, Support.CONTOUR),
        (cloud.points_world, Support.POINTS),
    ):
        if len(points):
            found[point_distances(centre, points) <= reach] = support
    return found


def near_points(
    faces: Faces,
    centre: Float[Tensor, "face 3"],
    cloud: OrientedPoints,
    support: Int[Tensor, " face"],
    counts: ViewCounts,
    pixel: float,
) -> FaceMask:
    """Find faces with points, and illuminated faces between points that are near to some.

    A component of faces further than the margin from all points is not marked if one of them is
    further than the gap: surface that spans a gap inside the object is joined to surface in
    the air beside it by strips along points, which the margin cuts through.
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
    """Find the faces that stay: in the visual hull, and seen or supported.

    Surface without points that views see through is dropped: it closes an opening, or floats in
    the air, and all of it goes where they see through enough of it. Faces that no view sees stay
    where they close a small hole; the back of an object seen from one side is a large one.

    Args:
        inside: True for faces in the visual hull.
        fraction: Of the supported area, that a component needs.
        least: Support of the faces whose area that is.
    """
    known = support >= Support.CONTOUR
    small = (HOLE_PX * pixel) ** 2
    bare = inside & (support != Support.POINTS)
    through = bare & (counts.behind >= _MIN_BEHIND)
    region = topology.face_components(faces, some := bare & (counts.seen > 0))
    share = torch.bincount(region, through.double()) / torch.bincount(region)
    through |= some & (share >= _MOST_THROUGH)[region]
    possible = without_small_holes(vertices, faces, inside & ~through, small)
    leave_out("coarse.seen_through", inside & ~possible, at=(vertices, faces))
    kept = possible & ((counts.seen > 0) | known)
    leave_out("coarse.unseen", possible & ~kept, at=(vertices, faces))
    area = float(total(surfaces.face_normals(vertices, faces[kept]).norm(dim=1))) / 2
    holes = enclosed_holes(vertices, faces, kept, MAX_UNSEEN * area)
    kept = kept | (holes & ~topology.connected_to(faces, ~kept, ~possible))
    kept = without_small_holes(vertices, faces, kept, small)
    # Narrow is what a morphological opening removes: small or unsupported spurs of the border.
    rings, count = int(HOLE_PX / (2 * CELL_PX)), len(vertices)
    core = ~topology.dilated(faces, ~kept, rings, count)
    strips = kept & ~topology.dilated(faces, core, rings, count)
    label = topology.face_components(faces, strips)
    areas = surfaces.component_areas(vertices, faces, label)
    borne = surfaces.component_areas(vertices, faces, label, support != Support.NOTHING)
    strips &= (areas < small) | (borne < areas / 2)
    leave_out("coarse.fringes", strips, at=(vertices, faces))
    kept &= ~strips
    (chosen,) = torch.nonzero(kept, as_tuple=True)
    stays = supported_components(vertices, faces[chosen], support[chosen] >= least, fraction)
    leave_out("coarse.components", ~stays, at=(vertices, faces[chosen]))
    kept[chosen[~stays]] = False
    return kept


def min_fraction(contours: Contours) -> float:
    """Return the fraction of the supported area that a component needs."""
    # Inside silhouettes even what others nearly hide is the object's: of six balls, the one behind
    # the others is in two pieces of less than 0.01 each.
    return 0.002 if contours.confine else 0.01
