"""Closing: every hole of a surface, and every outer border, gets a cap."""

import math

import torch
from torch import Tensor

from pimper_torch.ground.geometry.surfaces import vertex_normals
from pimper_torch.ground.geometry.topology import face_counts, face_edges, half_edges, vertex_fans
from pimper_torch.ground.linalg.continuation import continued
from pimper_torch.ground.shapes import Faces, VertexValues
from pimper_torch.method.meshing.faults import diagonal
from pimper_torch.records import Closed, Mesh
from pimper_torch.runtime.errors import InputError


def closed(mesh: Mesh) -> Closed:
    """Close every border of a mesh by a membrane, as a soap film would.

    What was there stays as it is, but that the mesh is made a manifold first: where fans of
    faces meet in a vertex only, each gets its own copy. A cap is a disk of rings, each with half
    the vertices of the one around it, so that it is as fine as its border outside and coarse
    inside. It says where the surface ends, not where the object is: its vertices have no
    confidence, the mesh's extent as expected error, and the albedo of the border continued. Caps
    of deep or twisted borders may cross the surface or themselves.

    Positions and albedo of caps are differentiable in those of the borders.

    Raises:
        InputError: Faces on two sides of an edge face opposite ways.
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
    fresh = count - len(source)

    extent = float(diagonal(mesh.vertices_world.detach()))

    def extended(values: Tensor | None, filler: float) -> Tensor | None:
        if values is None:
            return None
        return torch.cat([values[source], values.new_full((fresh, *values.shape[1:]), filler)])

    film = mesh.vertices_world[source]
    if mesh.albedo is not None:
        film = torch.cat([film, _known(mesh.albedo)[source].to(film)], dim=1)
    film = torch.cat([film, film.new_zeros(fresh, film.shape[1])])
    there = torch.arange(count, device=film.device) < len(source)
    film = continued(film, there, face_edges(added)[0], film, film.new_zeros(count))
    vertices, everything = film[:, :3], torch.cat([faces, added])
    normals = mesh.normals_world
    if normals is not None:
        normals = torch.cat([normals[source], vertex_normals(vertices, everything)[len(source) :]])
    whole = Mesh(
        vertices_world=vertices,
        faces=everything,
        normals_world=normals,
        albedo=None
        if mesh.albedo is None
        else torch.cat([mesh.albedo[source], film[len(source) :, 3:].to(mesh.albedo)]),
        confidence=extended(mesh.confidence, 0.0),
        expected_error=extended(mesh.expected_error, extent),
    )
    measured = torch.arange(len(everything), device=faces.device) < len(faces)
    return Closed(mesh=whole, measured=measured, borders=len(cycles))


def _known(albedo: VertexValues) -> VertexValues:
    """Assign vertices whose albedo no photograph shows the mean of the others'."""
    known = albedo.isfinite()
    mean = torch.where(known, albedo, 0).sum(dim=0) / known.sum(dim=0).clamp_min(1)
    return torch.where(known, albedo, mean)


def border_cycles(faces: Faces) -> list[list[int]]:
    """Order the border of an oriented manifold: every one a cycle, its faces on the right.

    A face on the other side of an edge runs the way of the cycle.
    """
    _, index = face_edges(faces)
    alone = (face_counts(index) == 1)[index].flatten()
    ends = half_edges(faces)[alone]
    first = ends[:, 1].tolist()
    following = dict(zip(first, ends[:, 0].tolist(), strict=True))
    if len(following) < len(first) or len(set(following.values())) < len(first):
        raise InputError(
            "faces next to each other face opposite ways, so that nothing tells outside from "
            "inside; needed: faces that all have their corners counter-clockwise from outside."
        )
    cycles, left = [], dict(following)
    for start in first:
        cycle = []
        while start in left:
            cycle.append(start)
            start = left.pop(start)
        if cycle:
            cycles.append(cycle)
    return cycles


def _disk(cycle: list[int], first: int) -> Faces:
    """Triangulate a disk in rings; its inner vertices are numbered from ``first``."""
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
