"""Red-green splitting: halve edges of a triangle mesh and keep it conforming.

A face with three halved edges becomes four similar ones (red); with one or two it is cut through to
the new vertices (green). Both faces of an edge are split at the same vertex, so no face has a
vertex of its neighbour on its edge.

Source: Bank, Sherman & Weiser, Scientific Computing, 1983, for red and green; Rivara, Int. J.
Numer. Meth. Eng. 20, 1984, for halving longest edges so that angles stay away from 0.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.surfaces import barycentric_2d, vertex_normals
from pimper_torch.geometry.topology import face_edges
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.linalg.sums import average, sum_at
from pimper_torch.records import CoarseMesh, FacetPoints, Mesh, Record, Surface
from pimper_torch.records.shapes import FaceMask, Faces, PerVertex, Points, Vertices

Children = Int[Tensor, " child"]

# Barycentric coordinates of a face's corners, and of the midpoints of the opposite edges.
_NODES = ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (0, 0.5, 0.5), (0.5, 0, 0.5), (0.5, 0.5, 0))

_RED = ((0, 5, 4), (5, 1, 3), (4, 3, 2), (3, 4, 5))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Split(Record):
    """The faces of a mesh after edges were halved.

    Attributes:
        faces: Old vertices keep their indices; one new vertex for each of ``halved`` follows.
        halved: Indices of the halved edges.
        parent: Old face that contains each new face, ascending.
        corners: Barycentric coordinates of each face's corners in its parent, a row per corner.
    """

    faces: Int[Tensor, "child 3"]
    halved: Int[Tensor, " new"]
    parent: Children
    corners: Float[Tensor, "child 3 3"]

    def relocate(
        self, parent: Int[Tensor, " point"], barycentric: Points
    ) -> tuple[Int[Tensor, " point"], Points]:
        """Return the child that contains each point or is nearest, and coordinates in it."""
        inverse = torch.linalg.inv(self.corners).to(barycentric)
        first = torch.searchsorted(self.parent, parent)
        last = torch.searchsorted(self.parent, parent, right=True) - 1
        child, inner = first, (barycentric[:, None] @ inverse[first])[:, 0]
        for slot in range(1, len(_RED)):
            (index,) = torch.nonzero(first + slot <= last, as_tuple=True)
            other = first[index] + slot
            candidate = (barycentric[index, None] @ inverse[other])[:, 0]
            better = candidate.amin(dim=1) > inner[index].amin(dim=1)
            child = child.index_copy(0, index[better], other[better])
            inner = inner.index_copy(0, index[better], candidate[better])
        return child, inner


def mark_edges(
    vertices: Vertices, faces: Faces, wanted: FaceMask, forbidden: FaceMask
) -> Bool[Tensor, " edge"]:
    """Return the mask of edges to halve, in the order of :func:`face_edges`.

    These are all edges of the wanted faces, and the longest edge of every face with a marked edge,
    so that no angle falls below half of the smallest original one, however often this is done.

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
    """Halve the marked edges, in the order of :func:`face_edges`. Faces keep their orientation."""
    _, face_edge = face_edges(faces)
    halved = marked.nonzero()[:, 0]
    midpoint = torch.full_like(marked, -1, dtype=torch.long)
    midpoint[halved] = len(vertices) + torch.arange(len(halved), device=faces.device)
    indices = torch.cat([faces, midpoint[face_edge]], dim=1)
    corners = vertices[faces]
    nodes = torch.tensor(_NODES, dtype=vertices.dtype, device=vertices.device)
    positions = nodes @ corners
    children, parents, coordinates = [], [], []
    for face, table in _cases(marked[face_edge], positions):
        if not len(face):
            continue
        local = torch.tensor(table, device=faces.device)
        children.append(indices[face][:, local].flatten(0, 1))
        parents.append(face.repeat_interleave(len(table)))
        coordinates.append(nodes[local].repeat(len(face), 1, 1))
    parent = torch.cat(parents)
    order = parent.argsort(stable=True)
    return Split(
        faces=torch.cat(children)[order],
        halved=halved,
        parent=parent[order],
        corners=torch.cat(coordinates)[order],
    )


def _cases(
    marked: Bool[Tensor, "face 3"], positions: Float[Tensor, "face 6 3"]
) -> list[tuple[Int[Tensor, " group"], tuple[tuple[int, int, int], ...]]]:
    """Return groups of faces that are cut alike, each with its children's corners in ``_NODES``."""
    count = marked.sum(dim=1)
    cases: list[tuple[Int[Tensor, " group"], tuple[tuple[int, int, int], ...]]] = [
        ((count == 0).nonzero()[:, 0], ((0, 1, 2),)),
        ((count == 3).nonzero()[:, 0], _RED),
    ]
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        centre = 3 + a
        single = (count == 1) & marked[:, a]
        cases.append((single.nonzero()[:, 0], ((a, b, centre), (a, centre, c))))
        p, q = 3 + c, 3 + b  # midpoints of ab and ac; bc is not halved
        double = (count == 2) & ~marked[:, a]
        # The shorter diagonal of the quadrangle is the median to the longer edge: larger angles.
        from_b = (positions[:, b] - positions[:, q]).norm(dim=1)
        from_c = (positions[:, c] - positions[:, p]).norm(dim=1)
        near = from_b <= from_c
        cases.append(((double & near).nonzero()[:, 0], ((a, p, q), (p, b, q), (b, c, q))))
        cases.append(((double & ~near).nonzero()[:, 0], ((a, p, q), (p, b, c), (p, c, q))))
    return cases


# Standard error of normals interpolated from a facet's corners; relative weight of surface normals
# that follow only from their neighbours. Choices.
_MODEL_ERROR_DEG, _MIN_WEIGHT = 8.0, 0.05


def normal_weights(information: PerVertex) -> PerVertex:
    """Return weights of normals relative to the best: inverse variance about interpolated ones.

    Args:
        information: Inverse variance of the normals, one over squared radians.
    """
    ratio = math.radians(_MODEL_ERROR_DEG) ** 2 * information
    return ratio / (1 + ratio) + _MIN_WEIGHT


def fitted_normals(mesh: Mesh, surface: Surface, split: Split, index: Children) -> Vertices:
    """Fit vertex normals so that their interpolation is nearest to the surface's normals.

    Least squares over the subdivided mesh, weighted by inverse variances. A facet without vertices
    of the subdivided mesh keeps the normals of the mesh.

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
    # Sums per facet first: a million subdivided mesh vertices are a few thousand blocks.
    blocks = sum_at(face, weight[:, :, None] * barycentric[:, None], len(faces))
    sums = sum_at(face, weight[:, :, None] * normals[:, None], len(faces))
    squares = blocks.diagonal(dim1=1, dim2=2).flatten()
    diagonal = sum_at(faces.flatten(), squares, len(vertices))
    rhs = sum_at(faces.flatten(), sums.flatten(0, 1), len(vertices))
    # Negligible except where there is no data.
    damping = (0.01 * average(diagonal)).clamp_min(1e-12).expand(len(vertices))
    initial = vertex_normals(vertices, faces)
    every = torch.arange(len(vertices), device=faces.device)
    fitted = SparseCholesky(
        torch.cat([faces[:, :, None].expand(-1, -1, 3).flatten(), every]),
        torch.cat([faces[:, None].expand(-1, 3, -1).flatten(), every]),
        torch.cat([blocks.flatten(), damping]),
        size=len(vertices),
        what="the coarse mesh's normals",
    ).solve(rhs + damping[:, None] * initial)
    facing = (fitted * initial).sum(dim=1, keepdim=True) > 0
    return normalize(torch.where(facing, fitted, initial), dim=1).to(mesh.vertices_world)


def with_relocated_points(
    coarse: CoarseMesh, mesh: Mesh, split: Split, index: Children
) -> CoarseMesh:
    """Return the coarse mesh of a new mesh, with the cloud's points and support of its facets.

    No vertex is a point of the cloud, as all have moved.
    """
    points = coarse.points
    return CoarseMesh(
        mesh=mesh,
        reference=coarse.reference,
        is_point=torch.zeros_like(mesh.vertices_world[:, 0], dtype=torch.bool),
        points=None if points is None else _relocated(coarse, points, split, index),
        support=None if coarse.support is None else coarse.support[split.parent[index >= 0]],
    )


def _relocated(
    coarse: CoarseMesh, points: FacetPoints, split: Split, index: Children
) -> FacetPoints:
    """Assign points to the child facets that they project into along the old normal."""
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
