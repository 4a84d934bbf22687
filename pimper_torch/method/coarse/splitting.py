"""Red-green splitting: some edges of a triangle mesh are halved, and it stays conforming.

A face with three halved edges becomes four of its own shape (red); with one or two it is cut
through to the new vertices (green). What an edge's two faces do follows from the edge alone, so
no face ever has a vertex of its neighbour on its edge.

Source: of red and green, Bank, Sherman & Weiser, Scientific Computing, 1983; of halving longest
edges so that angles stay away from 0, Rivara, Int. J. Numer. Meth. Eng. 20, 1984.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.surfaces import barycentric_2d, vertex_normals
from pimper_torch.ground.geometry.topology import face_edges
from pimper_torch.ground.linalg.sparse import SparseCholesky
from pimper_torch.ground.linalg.sums import average, sum_at
from pimper_torch.ground.shapes import FaceMask, Faces, PerVertex, Points, Vertices
from pimper_torch.records import CoarseMesh, FacetPoints, Mesh, Record, Surface

Children = Int[Tensor, " child"]

# Barycentric coordinates of a face's corners, and of the midpoints of the opposite edges.
_NODES = ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (0, 0.5, 0.5), (0.5, 0, 0.5), (0.5, 0.5, 0))

_RED = ((0, 5, 4), (5, 1, 3), (4, 3, 2), (3, 4, 5))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Split(Record):
    """A mesh, some of whose edges have been halved.

    Attributes:
        faces: Old vertices keep their indices; the new ones follow, one for each of ``halved``.
        parent: The face that each face is a part of, ascending.
        corners: Barycentric coordinates of each face's corners in its parent, row by row.
    """

    faces: Int[Tensor, "child 3"]
    halved: Int[Tensor, " new"]
    parent: Children
    corners: Float[Tensor, "child 3 3"]

    def relocate(
        self, parent: Int[Tensor, " point"], barycentric: Points
    ) -> tuple[Int[Tensor, " point"], Points]:
        """Return the child that each point of a face lies in or nearest to, and its coordinates."""
        inverse = torch.linalg.inv(self.corners).to(barycentric)
        first = torch.searchsorted(self.parent, parent)
        last = torch.searchsorted(self.parent, parent, right=True) - 1
        child, inner = first, (barycentric[:, None] @ inverse[first])[:, 0]
        for slot in range(1, len(_RED)):
            (more,) = torch.nonzero(first + slot <= last, as_tuple=True)
            other = first[more] + slot
            there = (barycentric[more, None] @ inverse[other])[:, 0]
            better = there.amin(dim=1) > inner[more].amin(dim=1)
            child = child.index_copy(0, more[better], other[better])
            inner = inner.index_copy(0, more[better], there[better])
        return child, inner


def mark_edges(
    vertices: Vertices, faces: Faces, wanted: FaceMask, forbidden: FaceMask
) -> Bool[Tensor, " edge"]:
    """Choose the edges to halve, in the order of :func:`face_edges`.

    All edges of the wanted faces; and of every face that has one of these its longest too, so
    that no angle shrinks below half of the smallest there was, however often this is done.

    Args:
        forbidden: Faces that keep all their edges, even if angles of others shrink.
    """
    edges, face_edge = face_edges(faces)
    ends = vertices[edges]
    length = (ends[:, 0] - ends[:, 1]).norm(dim=1)
    longest = face_edge.gather(1, length[face_edge].argmax(dim=1, keepdim=True))[:, 0]
    free = torch.ones_like(length, dtype=torch.bool)
    free[face_edge[forbidden].flatten()] = False
    marked = torch.zeros_like(free)
    marked[face_edge[wanted].flatten()] = True
    marked = marked & free
    while True:
        grown = marked.clone()
        grown[longest[marked[face_edge].any(dim=1)]] = True
        grown = grown & free
        if bool((grown == marked).all()):
            return marked
        marked = grown


def split_edges(vertices: Vertices, faces: Faces, marked: Bool[Tensor, " edge"]) -> Split:
    """Halve the marked edges, in the order of :func:`face_edges`; faces keep their orientation."""
    _, face_edge = face_edges(faces)
    halved = marked.nonzero()[:, 0]
    midpoint = torch.full_like(marked, -1, dtype=torch.long)
    midpoint[halved] = len(vertices) + torch.arange(len(halved), device=faces.device)
    names = torch.cat([faces, midpoint[face_edge]], dim=1)
    corners = vertices[faces]
    nodes = torch.tensor(_NODES, dtype=vertices.dtype, device=vertices.device)
    positions = nodes @ corners
    here = marked[face_edge]
    children, parents, inside = [], [], []
    for some, table in _cases(here, positions):
        if not len(some):
            continue
        local = torch.tensor(table, device=faces.device)
        children.append(names[some][:, local].flatten(0, 1))
        parents.append(some.repeat_interleave(len(table)))
        inside.append(nodes[local].repeat(len(some), 1, 1))
    parent = torch.cat(parents)
    order = parent.argsort(stable=True)
    return Split(
        faces=torch.cat(children)[order],
        halved=halved,
        parent=parent[order],
        corners=torch.cat(inside)[order],
    )


def _cases(
    marked: Bool[Tensor, "face 3"], positions: Float[Tensor, "face 6 3"]
) -> list[tuple[Int[Tensor, " some"], tuple[tuple[int, int, int], ...]]]:
    """List the faces that are cut in the same way, and their children's corners."""
    count = marked.sum(dim=1)
    cases: list[tuple[Int[Tensor, " some"], tuple[tuple[int, int, int], ...]]] = [
        ((count == 0).nonzero()[:, 0], ((0, 1, 2),)),
        ((count == 3).nonzero()[:, 0], _RED),
    ]
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        centre = 3 + a
        one = (count == 1) & marked[:, a]
        cases.append((one.nonzero()[:, 0], ((a, b, centre), (a, centre, c))))
        p, q = 3 + c, 3 + b  # the midpoints of ab and ac, where bc is whole
        two = (count == 2) & ~marked[:, a]
        # The shorter diagonal of the quadrangle is the median to the longer edge: larger angles.
        from_b = (positions[:, b] - positions[:, q]).norm(dim=1)
        from_c = (positions[:, c] - positions[:, p]).norm(dim=1)
        near = from_b <= from_c
        cases.append(((two & near).nonzero()[:, 0], ((a, p, q), (p, b, q), (b, c, q))))
        cases.append(((two & ~near).nonzero()[:, 0], ((a, p, q), (p, b, c), (p, c, q))))
    return cases


# Standard error of the normals that a facet blends from those of its corners, and the weight of a
# surface's normals that follow from their neighbours alone, over that of the best: choices.
_MODEL_ERROR_DEG, _MIN_WEIGHT = 8.0, 0.05


def normal_weights(information: PerVertex) -> PerVertex:
    """Return inverse variances of normals about those that facets blend, relative to the best.

    Args:
        information: Inverse variance of the normals, one over squared radians.
    """
    known = math.radians(_MODEL_ERROR_DEG) ** 2 * information
    return known / (1 + known) + _MIN_WEIGHT


def fitted_normals(mesh: Mesh, surface: Surface, split: Split, index: Children) -> Vertices:
    """Fit vertex normals whose blend over the facets is nearest to the surface's normals.

    Least squares over the subdivided mesh, weighted by inverse variances; where that has no
    vertex, the facets' own normals.

    Args:
        index: Of each child among the mesh's faces; -1 for a dropped one.
    """
    vertices, faces = mesh.vertices_world.double(), mesh.faces
    child, barycentric = split.relocate(surface.facet, surface.barycentric)
    face = index[child]
    (kept,) = torch.nonzero(face >= 0, as_tuple=True)
    face, barycentric = face[kept], barycentric[kept].double()
    weight = normal_weights(surface.information[kept].double())[:, None] * barycentric
    normals = surface.normals_world[kept].double()
    # Facet by facet first: a million subdivided mesh vertices are a few thousand blocks.
    blocks = sum_at(face, weight[:, :, None] * barycentric[:, None], len(faces))
    sums = sum_at(face, weight[:, :, None] * normals[:, None], len(faces))
    squares = blocks.diagonal(dim1=1, dim2=2).flatten()
    diagonal = sum_at(faces.flatten(), squares, len(vertices))
    rhs = sum_at(faces.flatten(), sums.flatten(0, 1), len(vertices))
    # Negligible except where there is no data.
    damping = (0.01 * average(diagonal)).clamp_min(1e-12).expand(len(vertices))
    own = vertex_normals(vertices, faces)
    every = torch.arange(len(vertices), device=faces.device)
    fitted = SparseCholesky(
        torch.cat([faces[:, :, None].expand(-1, -1, 3).flatten(), every]),
        torch.cat([faces[:, None].expand(-1, 3, -1).flatten(), every]),
        torch.cat([blocks.flatten(), damping]),
        size=len(vertices),
        what="the coarse mesh's normals",
    ).solve(rhs + damping[:, None] * own)
    facing = (fitted * own).sum(dim=1, keepdim=True) > 0
    return normalize(torch.where(facing, fitted, own), dim=1).to(mesh.vertices_world)


def with_points(
    coarse: CoarseMesh, mesh: Mesh, split: Split, index: Children, source: Int[Tensor, " vertex"]
) -> CoarseMesh:
    """Return the new mesh the points of the cloud on its facets, and the support of its facets.

    A vertex that was a point of the cloud and has moved is none any more: the point lies on a
    facet, at its own position with its own covariance.

    Args:
        source: The old vertex that each vertex is or is a copy of; new ones follow the old.
    """
    old, points, covariance = coarse.mesh.vertices_world, coarse.points, coarse.covariance_world
    origin = source.clamp_max(len(old) - 1)
    was_point = (source < len(old)) & coarse.is_point[origin]
    is_point = was_point & (mesh.vertices_world == old[origin]).all(dim=1)
    if points is not None:
        points = _relocated(coarse, points, split, index)
    if covariance is not None:
        (left,) = torch.nonzero(was_point & ~is_point, as_tuple=True)
        once = torch.ones_like(left, dtype=torch.bool)  # a vertex parted in two leaves one point
        once[1:] = origin[left][1:] != origin[left][:-1]
        left = left[once]
        first_face = mesh.faces.new_full((len(source),), len(mesh.faces)).scatter_reduce(
            0,
            mesh.faces.flatten(),
            torch.arange(len(mesh.faces), device=source.device).repeat_interleave(3),
            "amin",
        )
        moved = FacetPoints(
            points_world=old[origin[left]],
            covariance_world=covariance[origin[left]],
            facet=first_face[left],
        )
        points = moved if points is None else FacetPoints.cat([points, moved])
        covariance = torch.where(is_point[:, None, None], covariance[origin], 0)
    return CoarseMesh(
        mesh=mesh,
        reference=coarse.reference,
        is_point=is_point,
        covariance_world=covariance,
        points=points,
        support=None if coarse.support is None else coarse.support[split.parent[index >= 0]],
    )


def _relocated(
    coarse: CoarseMesh, points: FacetPoints, split: Split, index: Children
) -> FacetPoints:
    """Assign the points on facets to the children that they project into, along the old normal."""
    corners = coarse.mesh.vertices_world[coarse.mesh.faces[points.facet]]
    origin, along = corners[:, 0], corners[:, 1] - corners[:, 0]
    normal = torch.linalg.cross(along, corners[:, 2] - origin)
    x, normal = normalize(along, dim=1), normalize(normal, dim=1)
    axes = torch.stack([x, torch.linalg.cross(normal, x)], dim=2)
    flat = (corners - origin[:, None]) @ axes
    projected = ((points.points_world - origin)[:, None] @ axes)[:, 0]
    child, _ = split.relocate(points.facet, barycentric_2d(projected, flat))
    facet = index[child]
    return points.replace(facet=facet).take(facet >= 0)
