"""Mesh decimation with a bound on the distance of every removed vertex."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.surfaces import carried_normals
from pimper_torch.records import Mesh, Record
from pimper_torch.runtime.parallel import side_by_side

# Slices that threads process in parallel, vertices between them last; constant, so that the result
# does not depend on the number of threads.
_SLICES = 4

# Number of edges for the median length, which is then accurate to a few thousandths.
_EDGES = 100_000


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Simplified(Record):
    """A mesh with fewer vertices, and its deviation from the original one.

    Attributes:
        mesh: Its vertices are original ones, with all their values.
        kept: Original indices of its vertices.
        face: For every original vertex, the nearest face of ``mesh`` among those that replaced
            its own; -1 for kept vertices.
        spacing: Median edge length of the original mesh, scene units.
        max_spacings: Largest distance of a removed vertex to its face, in these units.
        max_angle_deg: Largest angle between the normals of a removed vertex and its face.
    """

    mesh: Mesh
    kept: Int[Tensor, " kept"]
    face: Int[Tensor, " vertex"]
    spacing: float
    max_spacings: float
    max_angle_deg: float


def simplify(
    mesh: Mesh,
    values: Float[Tensor, "vertex channel"] | None = None,
    *,
    spacings: float = 0.05,
    angle_deg: float = 1.5,
) -> Simplified:
    """Collapse edges as long as every removed vertex stays within bounds of the mesh.

    Border vertices, and vertices where more than one fan of faces meets, are kept. Kept vertices
    have exactly the same position, normal and other values as before. Topology is preserved.
    Differentiable only in the values of kept vertices.

    Args:
        mesh: Any; without normals, those of its shape are used.
        values: Additional values interpolated over the faces, in units of their bound: the value of
            a removed vertex and the interpolated one on its face differ by at most 1.
        spacings: Largest distance of a removed vertex to the surface, in multiples of the median
            edge. With a tenth, the finest height field of the demo's skull is lost if its shape is
            shaded without the vertices' normals.
        angle_deg: Largest angle between its normal and the surface's, interpolated from corners.
    """
    if len(mesh.faces) == 0:
        kept = torch.arange(len(mesh.vertices_world), device=mesh.faces.device)
        return Simplified(
            mesh=mesh,
            kept=kept,
            face=torch.full_like(kept, -1),
            spacing=0.0,
            max_spacings=0.0,
            max_angle_deg=0.0,
        )
    vertices = mesh.vertices_world.detach().cpu().double()
    normals = carried_normals(mesh)
    sample = mesh.faces.cpu()[:: max(1, len(mesh.faces) // _EDGES)]
    spacing = float((vertices[sample[:, 0]] - vertices[sample[:, 1]]).norm(dim=1).median())
    points = _rows(vertices - vertices.mean(dim=0))
    faces = mesh.faces.to("cpu", torch.int32, copy=True).contiguous().numpy()
    channels = _rows(normals if values is None else torch.cat([normals, values.to(normals)], dim=1))
    cosine = float(np.cos(np.radians(angle_deg)))
    lists, off = _decimate(points, channels, faces, spacings * spacing, cosine)
    remaining = faces[:, 0] >= 0
    used, renumbered = np.unique(faces[remaining], return_inverse=True)
    kept = torch.from_numpy(used).long().to(mesh.faces.device)
    fewer = torch.from_numpy(renumbered.reshape(-1, 3)).to(mesh.faces)
    return Simplified(
        mesh=mesh.take(kept).replace(faces=fewer),
        kept=kept,
        face=torch.from_numpy(_nearest_faces(lists, remaining)).to(mesh.faces),
        spacing=spacing,
        max_spacings=float(off[:, 0].max()) / spacing,
        max_angle_deg=float(np.degrees(np.arccos(min(1.0, float(off[:, 1].min()))))),
    )


def _decimate(
    points: np.ndarray, channels: np.ndarray, faces: np.ndarray, reach: float, cosine: float
) -> tuple[np.ndarray, np.ndarray]:
    """Collapse edges in place: removed faces become negative.

    Returns:
        Linked lists of the removed vertices of every face, and how far off each vertex is: its
        distance, and the cosine between normals.
    """
    from pimper_torch.kernels import decimation  # compiled when it is imported

    links = np.empty(len(points) + faces.size, np.int32)
    lists = np.full(len(faces) + len(points), -1, np.int32)
    off = np.tile(np.array([0, 1], np.float32), (len(points), 1))
    decimation.link_corners(faces, links)
    # Slices are perpendicular to the mesh's longest side and have equal numbers of vertices.
    along = points[:, np.ptp(points, axis=0).argmax()]
    cuts = np.quantile(along, np.arange(1, _SLICES) / _SLICES)
    labels = np.searchsorted(cuts, along).astype(np.int8)
    corners = labels[faces]
    between = np.zeros(len(points), bool)
    between[faces[(corners != corners[:, :1]).any(axis=1)]] = True
    candidates = ~between

    def thin_out(free: np.ndarray) -> None:
        arguments = (free, candidates, faces, links, lists, off)
        decimation.decimate(points, channels, reach, cosine, *arguments)

    inner = [(labels == label) & ~between for label in range(_SLICES)]
    list(side_by_side(thin_out, inner))
    candidates |= between
    thin_out(np.ones_like(between))
    return lists, off


def _nearest_faces(lists: np.ndarray, remaining: np.ndarray) -> np.ndarray:
    """Return the remaining face that lists each removed vertex; -1 for kept vertices."""
    heads, following = lists[: len(remaining)][remaining], lists[len(remaining) :]
    face = np.full(len(following), -1, np.int32)
    number, point = np.arange(len(heads)), heads
    while len(point):
        number, point = number[point >= 0], point[point >= 0]
        face[point] = number
        point = following[point]
    return face


def _rows(values: Float[Tensor, "vertex channel"]) -> np.ndarray:
    rows: np.ndarray = values.detach().cpu().float().contiguous().numpy()
    return rows
