"""Flatness of the planar sides of an object, and the angles between them.

A carton has no reference scan, but its sides are planes at right angles.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.surfaces import (
    face_normals,
    side_lengths,
    unit_face_normals,
    vertex_normals,
)
from pimper_torch.geometry.topology import face_components
from pimper_torch.records import Mesh, Record
from pimper_torch.runtime.errors import InputError

# Points that candidates for planes are scored on, and candidates for each plane.
_JUDGES, _CANDIDATES = 20_000, 256

# Iterations of fitting a plane to its inliers, and of selecting the inliers.
_REFITS = 8

# Normals are averaged over this fraction of the diagonal, because noise tilts small faces.
_SMOOTHING = 0.01

# The border is ignored if a side has this many vertices away from it; a side of a few large facets
# is only border.
_FEWEST_INSIDE = 12

# Maximum number of smoothing iterations over the mesh.
_MAX_ITERATIONS = 60


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PlanarFace(Record):
    """A flat side of a mesh, as it was found.

    Attributes:
        faces: Of the mesh, that make it up.
        normal: Of the plane, outward.
        point: In its centre.
        sides: Longer and shorter one of the smallest rectangle about it, scene units.
        area: Of its faces.
        rms: Root mean square distance of its vertices from the plane, by area, away from the
            border.
        p95: Distance that 95 % of it, by area, do not exceed.
    """

    faces: Int[Tensor, " face"]
    normal: Float[Tensor, " 3"]
    point: Float[Tensor, " 3"]
    sides: tuple[float, float]
    area: float
    rms: float
    p95: float

    @property
    def edge(self) -> float:
        """The side of a square as large as the rectangle."""
        return math.sqrt(self.sides[0] * self.sides[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Dihedral:
    """Two flat sides that meet.

    Attributes:
        one: Number of the first.
        other: Number of the second.
        angle_deg: Between them, inside the object: 90 for a box.
        length: Of the border they share, about; scene units.
    """

    one: int
    other: int
    angle_deg: float
    length: float


def planar_faces(
    mesh: Mesh,
    generator: torch.Generator,
    *,
    band: float = 0.02,
    max_angle_deg: float = 30.0,
    min_fraction: float = 0.04,
    margin: float = 0.05,
    most: int = 12,
) -> tuple[PlanarFace, ...]:
    """Find the flat sides of a mesh, the largest first.

    Sequential RANSAC: of planes through random positions on the remaining surface (uniform by area,
    along its smoothed normal), the one with most area near it is refitted by least squares, and its
    largest connected component is a side.

    Args:
        mesh: Orientation outward.
        generator: On the CPU; for the positions.
        band: Maximum distance of a side from its plane, as a fraction of the mesh's diagonal.
            Farther vertices belong to no side and do not count in its flatness.
        max_angle_deg: Maximum angle of its smoothed normals with the plane's.
        min_fraction: Minimum area of a side, as a fraction of the mesh's.
        margin: Width of the border that flatness ignores, as a fraction of the side's edge,
            because edges are rounded.
        most: Maximum number of sides.

    Raises:
        InputError: A mesh without area.
    """
    vertices, faces = mesh.vertices_world.detach().cpu().double(), mesh.faces.cpu()
    area = face_normals(vertices, faces).norm(dim=1) / 2
    if not bool(area.sum() > 0):
        raise InputError(
            f"planes: a mesh of {len(faces)} faces without area; needed: a surface. Check "
            "the mesh file."
        )
    diagonal = (vertices.amax(dim=0) - vertices.amin(dim=0)).norm()
    normals = _smoothed_face_normals(vertices, faces, _SMOOTHING * float(diagonal))
    centres = vertices[faces].mean(dim=1)
    width, cosine = band * diagonal, math.cos(math.radians(max_angle_deg))
    left = torch.ones_like(area, dtype=torch.bool)
    found: list[PlanarFace] = []
    while len(found) < most and bool(area[left].sum() > min_fraction * area.sum()):
        weight = torch.where(left, area, 0)
        judges = torch.multinomial(weight, _JUDGES, replacement=True, generator=generator)
        tried = judges[torch.randperm(_JUDGES, generator=generator)[:_CANDIDATES]]
        height = centres[judges] @ normals[tried].T - (centres[tried] * normals[tried]).sum(dim=1)
        near = (height.abs() < width) & (normals[judges] @ normals[tried].T > cosine)
        best = tried[near.sum(dim=0).argmax()]
        normal, point = normals[best], centres[best]
        for _ in range(_REFITS):
            near = _near(centres, normals, normal, point, width, cosine) & left
            if int(near.sum()) < 3:
                break
            normal, point = _plane(centres[near], area[near], normal)
        near = _near(centres, normals, normal, point, width, cosine) & left
        (members,) = torch.nonzero(near, as_tuple=True)
        if len(members) == 0:
            break
        members = _largest_part(faces, area, members)
        left[members] = False
        if area[members].sum() < min_fraction * area.sum():
            if near.sum() == len(members) or area[near].sum() < min_fraction * area.sum():
                break
            continue
        found.append(_measured(vertices, faces, members, normal, margin))
    return tuple(sorted(found, key=lambda face: -face.area))


def dihedrals(
    mesh: Mesh,
    sides: tuple[PlanarFace, ...],
    *,
    reach: float = 0.04,
    min_length: float = 0.3,
    min_rotation_deg: float = 20.0,
) -> tuple[Dihedral, ...]:
    """Measure the angles between flat sides that meet.

    Args:
        mesh: They were found on.
        sides: From :func:`planar_faces`.
        reach: How near they must come, as a fraction of the mesh's diagonal.
        min_length: Of the border they share, as a fraction of the shorter one's edge.
        min_rotation_deg: Sides turned less are two halves of one.
    """
    vertices, faces = mesh.vertices_world.detach().cpu().double(), mesh.faces.cpu()
    far = reach * float((vertices.amax(dim=0) - vertices.amin(dim=0)).norm())
    positions = [vertices[torch.unique(faces[side.faces])].numpy() for side in sides]
    trees = [cKDTree(some) for some in positions]
    found = []
    for one, first in enumerate(sides):
        for other in range(one + 1, len(sides)):
            second = sides[other]
            rotation = math.degrees(math.acos(float((first.normal @ second.normal).clamp(-1, 1))))
            distance, _ = trees[other].query(positions[one], distance_upper_bound=far)
            border = positions[one][np.isfinite(distance)]
            if len(border) < 2 or rotation < min_rotation_deg:
                continue
            along = normalize(torch.linalg.cross(first.normal, second.normal), dim=0).numpy()
            length = float(np.ptp(border @ along))
            if length >= min_length * min(first.edge, second.edge):
                found.append(
                    Dihedral(one=one, other=other, angle_deg=180 - rotation, length=length)
                )
    return tuple(found)


def _near(
    centres: Float[Tensor, "face 3"],
    normals: Float[Tensor, "face 3"],
    normal: Float[Tensor, " 3"],
    point: Float[Tensor, " 3"],
    width: Float[Tensor, ""],
    cosine: float,
) -> Bool[Tensor, " face"]:
    return (((centres - point) @ normal).abs() < width) & (normals @ normal > cosine)


def _plane(
    points: Float[Tensor, "point 3"], weight: Float[Tensor, " point"], like: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """Fit a plane by least squares; its normal on the side of ``like``."""
    fraction = weight / weight.sum()
    centre = (fraction[:, None] * points).sum(dim=0)
    offset = points - centre
    normal = torch.linalg.eigh((fraction[:, None] * offset).T @ offset).eigenvectors[:, 0]
    return torch.where(normal @ like < 0, -normal, normal), centre


def _largest_part(
    faces: Int[Tensor, "face 3"], area: Float[Tensor, " face"], members: Int[Tensor, " member"]
) -> Int[Tensor, " part"]:
    label = face_components(faces[members])
    areas = area.new_zeros(int(label.max()) + 1).index_add(0, label, area[members])
    return members[label == areas.argmax()]


def _measured(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    members: Int[Tensor, " member"],
    like: Float[Tensor, " 3"],
    margin: float,
) -> PlanarFace:
    """Fit the plane to the inner part of a side, and measure distances from it."""
    corners = faces[members]
    area = face_normals(vertices, corners).norm(dim=1) / 2
    fraction = area.new_zeros(len(vertices)).index_add(
        0, corners.flatten(), area.repeat_interleave(3)
    )
    (used,) = torch.nonzero(fraction > 0, as_tuple=True)
    points, weight = vertices[used], fraction[used]
    normal, centre = _plane(points, weight, like)
    frame = torch.linalg.svd(normal[None]).Vh[1:]
    flat = ((points - centre) @ frame.T).numpy()
    hull = ConvexHull(flat)
    sides = _rectangle(flat[hull.vertices])
    rim = margin * math.sqrt(sides[0] * sides[1])
    outside = (flat @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1)
    inner = torch.from_numpy(outside < -rim)
    if int(inner.sum()) >= _FEWEST_INSIDE:
        normal, centre = _plane(points[inner], weight[inner], like)
        points, weight = points[inner], weight[inner]
    distance = ((points - centre) @ normal).abs()
    order = distance.argsort()
    below = weight[order].cumsum(dim=0) / weight.sum()
    last = int(torch.searchsorted(below, 0.95).clamp_max(len(order) - 1))
    return PlanarFace(
        faces=members,
        normal=normal,
        point=centre,
        sides=sides,
        area=float(area.sum()),
        rms=float(((weight * distance.square()).sum() / weight.sum()).sqrt()),
        p95=float(distance[order[last]]),
    )


def _rectangle(hull: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> tuple[float, float]:
    """Return the sides of the smallest rectangle around a convex polygon: one is along an edge."""
    steps = np.roll(hull, -1, axis=0) - hull
    along = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    widths, heights = np.ptp(hull @ along.T, axis=0), np.ptp(hull @ across.T, axis=0)
    best = int((widths * heights).argmin())
    longer, shorter = max(widths[best], heights[best]), min(widths[best], heights[best])
    return float(longer), float(shorter)


def _smoothed_face_normals(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], length: float
) -> Float[Tensor, "face 3"]:
    """Average normals over about ``length``: n rounds over the mesh reach the root of n edges."""
    corners = vertices[faces]
    edge = float(side_lengths(corners).median())
    iterations = min(_MAX_ITERATIONS, round((length / max(edge, 1e-30)) ** 2))
    if iterations == 0:
        return unit_face_normals(vertices, faces)
    smooth = vertex_normals(vertices, faces)
    for _ in range(iterations):
        around = smooth[faces].sum(dim=1).repeat_interleave(3, dim=0)
        total = torch.zeros_like(smooth).index_add(0, faces.flatten(), around)
        smooth = normalize(total, dim=1)
    return normalize(smooth[faces].sum(dim=1), dim=1)
