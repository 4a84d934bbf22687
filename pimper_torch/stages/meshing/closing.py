"""Closing of a surface: caps over every hole and every outer border."""

import math

import torch
from jaxtyping import Bool, Int
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.geometry import topology
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.topology import face_counts, face_edges, half_edges, vertex_fans
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.linalg.continuation import continued
from pimper_torch.records import ClosedMesh, Mesh
from pimper_torch.records.shapes import FaceMask, Faces, VertexValues, Vertices
from pimper_torch.runtime.errors import InputError
from pimper_torch.stages.meshing.extract import large_components
from pimper_torch.stages.meshing.faults import bounding_diagonal

# The demo's skull takes 6 trims, 1 % of its faces.
_TRIMS, _LEAST_LEFT = 20, 0.9
# Rings trimmed around crossed faces; least area of a piece that stays, over the largest.
_RINGS, _PIECE = 2, 0.01
# Ends of edges, over their length, that are not tested: caps and surface touch at borders.
_ENDS = 1e-3


def closed(mesh: Mesh) -> ClosedMesh:
    """Close every border of a mesh with a cap that does not cut through the surface.

    Borders are trimmed where their cap (see :func:`capped`) would intersect the surface or itself,
    until none does, or a tenth of the faces would be lost: then caps may still intersect it.
    Otherwise the given surface is unchanged.

    Raises:
        InputError: Neighbouring faces have opposite orientation.
    """
    result = capped(mesh)
    for _ in range(_TRIMS):
        crossed = _crossed(result)
        if not bool(crossed.any()):
            break
        faces = result.mesh.faces[result.measured]
        keep = ~topology.dilated(faces, crossed, _RINGS, len(result.mesh.vertices_world))
        faces = faces[keep]
        if len(faces) < _LEAST_LEFT * len(mesh.faces):
            break
        vertices = result.mesh.vertices_world
        pieces = large_components(vertices.detach(), faces, _PIECE, face_edges(faces))
        used, faces = torch.unique(faces[pieces], return_inverse=True)
        result = capped(result.mesh.take(used).replace(faces=faces))
    return result


def _crossed(mesh: ClosedMesh) -> FaceMask:
    """Return measured faces that intersect caps, or are nearest to caps that intersect caps."""
    vertices = mesh.mesh.vertices_world.detach().cpu()
    surface, caps = (mesh.mesh.faces[which].cpu() for which in (mesh.measured, ~mesh.measured))
    crossed = _crossings(vertices, surface, caps)[0] | _crossings(vertices, caps, surface)[1]
    twisted = torch.unique(caps[_crossings(vertices, caps, caps)[0]])
    if len(twisted):
        border = torch.unique(caps[caps <= surface.max()])
        nearest = cKDTree(vertices[border]).query(vertices[twisted])[1]
        crossed = crossed | torch.isin(surface, border[nearest]).any(dim=1)
    return crossed


def _crossings(
    vertices: Vertices, first: Int[Tensor, "first 3"], second: Int[Tensor, "second 3"]
) -> tuple[Bool[Tensor, " first"], Bool[Tensor, " second"]]:
    """Return the first faces with edges through second faces, and these; not those that touch."""
    through = torch.zeros(len(second), dtype=torch.bool)
    ends = half_edges(first)
    if len(first) == 0 or len(second) == 0:
        return torch.zeros(len(first), dtype=torch.bool), through
    start, along = vertices[ends[:, 0]], vertices[ends[:, 1]] - vertices[ends[:, 0]]
    reach = along.new_full((len(along),), 1 - 2 * _ENDS)
    met = RayCaster(vertices, second).cast(start + _ENDS * along, along, reach).face
    apart = (second[met][:, :, None] != ends[:, None, :]).flatten(1).all(dim=1) & (met >= 0)
    through[met[apart]] = True
    return apart.reshape(-1, 3).any(dim=1), through


def capped(mesh: Mesh) -> ClosedMesh:
    """Close every border of a mesh with a membrane, like a soap film.

    The given surface is unchanged, except that the mesh is made a manifold first: if fans of faces
    meet only at a vertex, each gets its own copy. A cap is a disk of rings, each with half the
    vertices of the ring around it, so it is as fine as the border outside and coarse inside. It
    shows where the surface ends, not where the object is: its vertices have confidence 0, the
    mesh's extent as expected error, and the continued albedo of the border. Caps of deep or twisted
    borders may intersect the surface or themselves.

    Positions and albedo of caps are differentiable in those of the borders.

    Raises:
        InputError: Neighbouring faces have opposite orientation.
    """
    source, faces = vertex_fans(mesh.faces)
    count = len(source)
    cycles = border_cycles(faces)
    caps = [faces.new_zeros(0, 3)]
    for cycle in cycles:
        cap = _disk(cycle, count)
        count = max(count, int(cap.max()) + 1)
        caps.append(cap.to(faces))
    added = torch.cat(caps)
    num_new = count - len(source)

    extent = float(bounding_diagonal(mesh.vertices_world.detach()))

    def extended(values: Tensor | None, filler: float) -> Tensor | None:
        if values is None:
            return None
        return torch.cat([values[source], values.new_full((num_new, *values.shape[1:]), filler)])

    film = mesh.vertices_world[source]
    if mesh.albedo is not None:
        film = torch.cat([film, _filled(mesh.albedo)[source].to(film)], dim=1)
    film = torch.cat([film, film.new_zeros(num_new, film.shape[1])])
    given = torch.arange(count, device=film.device) < len(source)
    film = continued(film, given, face_edges(added)[0], film, film.new_zeros(count))
    vertices, all_faces = film[:, :3], torch.cat([faces, added])
    normals = mesh.normals_world
    if normals is not None:
        normals = torch.cat([normals[source], vertex_normals(vertices, all_faces)[len(source) :]])
    result = Mesh(
        vertices_world=vertices,
        faces=all_faces,
        normals_world=normals,
        albedo=None
        if mesh.albedo is None
        else torch.cat([mesh.albedo[source], film[len(source) :, 3:].to(mesh.albedo)]),
        confidence=extended(mesh.confidence, 0.0),
        expected_error=extended(mesh.expected_error, extent),
    )
    measured = torch.arange(len(all_faces), device=faces.device) < len(faces)
    return ClosedMesh(mesh=result, measured=measured, borders=len(cycles))


def _filled(albedo: VertexValues) -> VertexValues:
    """Return the albedo with the mean where it is not measured."""
    measured = albedo.isfinite()
    mean = torch.where(measured, albedo, 0).sum(dim=0) / measured.sum(dim=0).clamp_min(1)
    return torch.where(measured, albedo, mean)


def border_cycles(faces: Faces) -> list[list[int]]:
    """Return the borders of an oriented manifold as cycles of vertices, faces on their right.

    Faces of a cap use the edges in the direction of the cycle.
    """
    _, index = face_edges(faces)
    alone = (face_counts(index) == 1)[index].flatten()
    ends = half_edges(faces)[alone]
    first = ends[:, 1].tolist()
    following = dict(zip(first, ends[:, 0].tolist(), strict=True))
    if len(following) < len(first) or len(set(following.values())) < len(first):
        raise InputError(
            "neighbouring faces have opposite orientation, so inside and outside are undefined; "
            "needed: corners of all faces counter-clockwise as seen from outside."
        )
    cycles = []
    for start in first:
        cycle = []
        while start in following:
            cycle.append(start)
            start = following.pop(start)
        if cycle:
            cycles.append(cycle)
    return cycles


def _disk(cycle: list[int], first: int) -> Faces:
    """Return faces of a disk in rings; its inner vertices are numbered from ``first``."""
    if len(cycle) == 3:
        return torch.tensor([cycle])
    outer, triangles = torch.tensor(cycle), []
    while len(outer) > 6:
        inner = torch.arange(first, first + math.ceil(len(outer) / 2))
        first += len(inner)
        start, after = outer, outer.roll(-1)
        over = inner[torch.arange(len(outer)) // 2]  # each inner vertex is below two edges
        triangles.append(torch.stack([start, after, over], dim=1))
        ahead = torch.cat([outer[2::2], outer[:1]])
        triangles.append(torch.stack([ahead, inner.roll(-1), inner], dim=1))
        outer = inner
    centre = torch.full_like(outer, first)
    triangles.append(torch.stack([outer, outer.roll(-1), centre], dim=1))
    return torch.cat(triangles)
