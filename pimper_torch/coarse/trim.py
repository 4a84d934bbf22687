"""Which faces of a closed surface the photographs bear out."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.coarse.densify import DepthMaps
from pimper_torch.coarse.matching import Level
from pimper_torch.geometry.components import component_areas, face_components, graph_components
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.surfaces import (
    corners_of,
    face_normals,
    face_pairs,
    side_lengths,
)
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.parallel import num_workers, side_by_side
from pimper_torch.records import Cameras, Record

# Cosine between a face's normal and the ray to a camera, above which the view shows it.
_FACING = 0.1

# Steps of inverse depth in front of what a view sees, beyond which it denies a face.
_DENIED_STEPS = 4.0

# Tone (root of radiance over the bright level) above which a pixel shows something: a
# twentieth of the bright level's radiance, the pedestal left out.
_LIT_TONE = 0.06**0.5


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Terms(Record):
    """What the photographs say about faces.

    Attributes:
        seen: In how many views a face is unhidden, within the picture, not turned away.
        lit: In how many of them its pixel shows more than darkness.
        denied: How many views see something behind it.
    """

    seen: Int[Tensor, " face"]
    lit: Int[Tensor, " face"]
    denied: Int[Tensor, " face"]


def terms(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    level: Level,
    maps: DepthMaps | None,
) -> Terms:
    """Ask every view about the centre of every face.

    Args:
        vertices: Of the surface.
        faces: Of it.
        level: Photographs, at the resolution of the depth maps.
        maps: What lies behind a face; without, nothing does.
    """
    cameras = level.cameras
    centre = vertices[faces].mean(dim=1)
    normals = normalize(face_normals(vertices, faces), dim=-1)
    side = side_lengths(vertices[faces]).amax(dim=1)
    caster = RayCaster(vertices, faces)

    def said(view: int) -> Int[Tensor, "kind face"]:
        seen, lit, denied = torch.zeros_like(faces[:, 0]).expand(3, -1).clone()
        asked, column, row, depth = _shown(centre, cameras, view)
        center = cameras.centers_world[view]
        towards = normalize(center - centre[asked], dim=-1)
        facing = (towards * normals[asked]).sum(dim=-1) > _FACING
        asked, column, row, depth = asked[facing], column[facing], row[facing], depth[facing]
        column = column.clamp_max(level.tone.shape[-1] - 1)
        row = row.clamp_max(level.tone.shape[-2] - 1)
        if maps is not None:
            behind = maps.inverse_depth[view, row, column] + _DENIED_STEPS * maps.step[view]
            denied[asked] = (maps.valid[view, row, column] & (1 / depth > behind)).long()
        open_ = ~caster.occluded(centre[asked], center, 0.5 * side[asked])
        open_ &= level.usable[view, row, column]
        seen[asked] = open_.long()
        lit[asked] = (open_ & (level.tone[view, row, column] > _LIT_TONE)).long()
        return torch.stack([seen, lit, denied])

    total = torch.zeros_like(faces[:, 0]).expand(3, -1).clone()
    for one in side_by_side(said, range(cameras.num_views), tracked=False):
        total += one
    seen, lit, denied = total
    return Terms(seen=seen, lit=lit, denied=denied)


def _shown(
    points: Float[Tensor, "point 3"], cameras: Cameras, view: int
) -> tuple[Int[Tensor, " shown"], Int[Tensor, " shown"], Int[Tensor, " shown"], Tensor]:
    """List the points inside a view's picture: which, column, row, depth."""
    pixels, depth = project(points, cameras.cam_from_world[view], cameras.intrinsics[view])
    within = ((pixels >= 0) & (pixels < cameras.sizes_px[view])).all(dim=1) & (depth > 0)
    column, row = pixels[within].floor().long().unbind(dim=-1)
    return within.nonzero()[:, 0], column, row, depth[within]


def point_distances(
    places: Float[Tensor, "place 3"], points: Float[Tensor, "point 3"]
) -> Float[Tensor, " place"]:
    """Give each place's distance to the nearest point."""
    tree = cKDTree(points.detach().cpu().numpy())
    distance, _ = tree.query(places.detach().cpu().numpy(), workers=num_workers())
    return torch.from_numpy(distance).to(places)


def hanging_together(
    faces: Int[Tensor, "face 3"], among: Bool[Tensor, " face"], marked: Bool[Tensor, " face"]
) -> Bool[Tensor, " face"]:
    """Mark all faces that hang together with marked ones through faces ``among`` only."""
    pairs, _ = face_pairs(faces)
    label = graph_components(pairs[among[pairs].all(dim=1)], len(faces))
    count = torch.zeros_like(label).index_add(0, label, (marked & among).long())
    return among & (count[label] > 0)


def too_far(
    faces: Int[Tensor, "face 3"],
    between: Bool[Tensor, " face"],
    distance: Float[Tensor, " face"],
    gap: float,
    brink: float,
) -> Bool[Tensor, " face"]:
    """Mark faces between points that are further than ``gap`` from all, and their surroundings.

    These are what hangs together with them further than ``brink`` from all points: what spans
    a gap inside the object is joined to what hangs in the air by strips along points, which
    cut nothing off here.
    """
    return hanging_together(faces, between & (distance > brink), distance > gap)


def without_small_holes(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    kept: Bool[Tensor, " face"],
    largest: float,
) -> Bool[Tensor, " face"]:
    """Take back dropped faces that hang together over less than an area, in scene units."""
    pairs, _ = face_pairs(faces)
    dropped = pairs[~kept[pairs].any(dim=1)]
    areas = component_areas(vertices, faces, graph_components(dropped, len(faces)))
    return kept | (~kept & (areas < largest))


def enclosed_holes(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    kept: Bool[Tensor, " face"],
    largest: float,
) -> Bool[Tensor, " face"]:
    """Mark connected dropped faces that kept ones enclose, of no more than an area together.

    What reaches the border of the surface is not enclosed.
    """
    found = torch.zeros_like(kept)
    (dropped,) = torch.nonzero(~kept, as_tuple=True)
    if not len(dropped):
        return found
    label = face_components(faces[dropped])
    paired = torch.bincount(face_pairs(faces)[0].flatten(), minlength=len(faces))
    on_border = torch.zeros_like(label).index_add(0, label, (paired[dropped] < 3).long())
    areas = component_areas(vertices, faces[dropped], label)
    found[dropped] = (on_border[label] == 0) & (areas <= largest)
    return found


def fringes(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    kept: Bool[Tensor, " face"],
    supported: Bool[Tensor, " face"],
    smallest: float,
    rings: int,
) -> Bool[Tensor, " face"]:
    """Mark narrow strips and spurs beside dropped faces that little supports.

    Narrow is what a morphological opening takes away: erosion by so many rings of faces, then
    dilation. Of that, components go that are smaller than an area, or less than half supported:
    what is thin and supported, such as a handle seen from one side, stays.

    Args:
        vertices: Of the surface.
        faces: Of it.
        kept: Which are not dropped.
        supported: Faces that something supports.
        smallest: Area of a component that stays if it is supported.
        rings: Half the width of the widest strip that is narrow, in faces.
    """
    core = ~_dilated(faces, ~kept, rings, len(vertices))
    narrow = kept & ~_dilated(faces, core, rings, len(vertices))
    pairs, _ = face_pairs(faces)
    label = graph_components(pairs[narrow[pairs].all(dim=1)], len(faces))
    area = component_areas(vertices, faces, label)
    known = component_areas(vertices, faces, label, supported)
    return narrow & ((area < smallest) | (known < area / 2))


def _dilated(
    faces: Int[Tensor, "face 3"], some: Bool[Tensor, " face"], rings: int, num_vertices: int
) -> Bool[Tensor, " face"]:
    """Mark some faces and so many rings of faces round them."""
    for _ in range(rings):
        some = corners_of(faces, some, num_vertices)[faces].any(dim=1)
    return some


def supported_pieces(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    supported: Bool[Tensor, " face"],
    fraction: float,
) -> Bool[Tensor, " face"]:
    """Mark the faces of components that hold a fraction of all the area that is supported."""
    everything = torch.zeros_like(faces[:, 0])
    own, total = (
        component_areas(vertices, faces, label, supported)
        for label in (face_components(faces), everything)
    )
    return own >= fraction * total
