"""Mesh decimation with a bound on the distance of every former vertex."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.ground.geometry.surfaces import vertex_normals
from pimper_torch.records import Mesh, Record
from pimper_torch.runtime.parallel import side_by_side

# Slices of the mesh that threads work on side by side; a constant, so that the result does not
# depend on the number of threads. Vertices between slices come last.
_SLICES = 4

# Edges of which the median is taken: it is certain to a few thousandths.
_EDGES = 100_000


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Simplified(Record):
    """A mesh with fewer vertices, and how far the others are from it.

    Attributes:
        mesh: Its vertices are former ones, with all their values.
        face: The face of ``mesh`` that every former vertex is nearest to among those that
            replaced its own; -1 for vertices that are kept.
        spacing: Median edge of the former mesh, scene units.
        max_spacings: Largest distance of a former vertex from its face, in multiples of that.
        max_angle_deg: Largest angle between its normal and that of its face.
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
    """Collapse edges as long as every former vertex stays within bounds of the mesh.

    Vertices of a border, and where more than one fan of faces meets, stay. Nothing moves: the
    remaining vertices keep position, normal and all other values to the last digit. Topology
    stays, too. A constant to autograd but for the values of what is kept.

    Args:
        mesh: Any; without normals, those of its shape are taken.
        values: More that is interpolated over the faces, in units of its bound: the value of a
            removed vertex and that interpolated on its face differ by 1 at most.
        spacings: Distance of a former vertex to the surface at most, in multiples of the median
            edge. With a tenth, the finest height field of the demo's skull is lost where its shape
            is shaded without the vertices' normals.
        angle_deg: Between its normal and the surface's, which is blended from the corners.
    """
    from pimper_torch.ground.kernels import decimation  # compiled when it is imported

    if len(mesh.faces) == 0:
        everything = torch.arange(len(mesh.vertices_world), device=mesh.faces.device)
        return Simplified(
            mesh=mesh,
            kept=everything,
            face=torch.full_like(everything, -1),
            spacing=0.0,
            max_spacings=0.0,
            max_angle_deg=0.0,
        )
    vertices = mesh.vertices_world.detach().cpu().double()
    normals = mesh.normals_world
    if normals is None:
        normals = vertex_normals(mesh.vertices_world, mesh.faces)
    some = mesh.faces.cpu()[:: max(1, len(mesh.faces) // _EDGES)]
    spacing = float((vertices[some[:, 0]] - vertices[some[:, 1]]).norm(dim=1).median())
    points = _rows(vertices - vertices.mean(dim=0))
    faces = mesh.faces.to("cpu", torch.int32, copy=True).contiguous().numpy()
    channels = _rows(normals if values is None else torch.cat([normals, values.to(normals)], dim=1))
    links = np.empty(len(points) + faces.size, np.int32)
    lists = np.full(len(faces) + len(points), -1, np.int32)
    off = np.tile(np.array([0, 1], np.float32), (len(points), 1))
    cosine = float(np.cos(np.radians(angle_deg)))
    decimation.link_corners(faces, links)

    # Slices lie across the mesh's longest side; all have as many vertices.
    along = points[:, np.ptp(points, axis=0).argmax()]
    cuts = np.quantile(along, np.arange(1, _SLICES) / _SLICES)
    part = np.searchsorted(cuts, along).astype(np.int8)
    corners = part[faces]
    between = np.zeros(len(points), bool)
    between[faces[(corners != corners[:, :1]).any(axis=1)]] = True
    candidates = ~between

    def thin_out(free: np.ndarray) -> None:
        arguments = (free, candidates, faces, links, lists, off)
        decimation.decimate(points, channels, spacings * spacing, cosine, *arguments)

    inner = [(part == mine) & ~between for mine in range(_SLICES)]
    list(side_by_side(thin_out, inner))
    candidates |= between
    thin_out(np.ones_like(between))

    left = faces[:, 0] >= 0
    kept, renumbered = np.unique(faces[left], return_inverse=True)
    chosen = torch.from_numpy(kept).long().to(mesh.faces.device)
    fewer = torch.from_numpy(renumbered.reshape(-1, 3)).to(mesh.faces)
    return Simplified(
        mesh=mesh.take(chosen).replace(faces=fewer),
        kept=chosen,
        face=torch.from_numpy(_listed(lists, left)).to(mesh.faces),
        spacing=spacing,
        max_spacings=float(off[:, 0].max()) / spacing,
        max_angle_deg=float(np.degrees(np.arccos(min(1.0, float(off[:, 1].min()))))),
    )


def _listed(lists: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Return the remaining face of every removed vertex, and -1 of the others."""
    heads, following = lists[: len(left)][left], lists[len(left) :]
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
