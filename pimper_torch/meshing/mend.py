"""Broken places of a surface, mended: their vertices go where it bends least.

The faces stay as they are, so that what was closed stays closed.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from torch import Tensor

from pimper_torch.geometry.components import vertex_components
from pimper_torch.geometry.surfaces import face_edges
from pimper_torch.linalg.systems import solutions
from pimper_torch.meshing.groups import small_groups

# Rings of sound vertices that a place which stays broken may take in, one at a time.
_RINGS = 6


def mend(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    broken: Callable[[Float[Tensor, "vertex 3"]], Bool[Tensor, " face"]],
    max_extent: Float[Tensor, ""],
) -> tuple[Float[Tensor, "vertex 3"], Bool[Tensor, " vertex"]]:
    """Move the vertices of broken faces that sound ones enclose, until none is broken.

    The vertices of a group of broken faces are placed where the surface bends least; while some
    face there is broken still, the group takes in the vertices round it. A group that touches
    the border, or extends too far, or stays broken, is left as it is.

    Args:
        vertices: World.
        faces: Of the surface. Edges without two of them are its border.
        broken: Marks faces, for vertices anywhere.
        max_extent: Diagonal of a group's bounding box, once it is placed.

    Returns:
        The vertices, and which of them were moved.

    Differentiable in the vertices that stay; which these are is a constant.
    """
    before, count = vertices.detach(), len(vertices)
    held = _border(faces, count)
    free = _corners(faces, broken(before), count)
    free = _anchored(faces, free & ~_together(faces, free, held))
    for ring in range(_RINGS + 1):
        places = least_bent(before, faces, free)
        held = held | (free & ~small_groups(places, faces, free, max_extent))
        free = free & ~held
        still = _together(faces, free, _corners(faces, broken(places), count))
        if not bool(still.any()):
            break
        wider = _corners(faces, still[faces].any(dim=1), count) & ~held
        free = free & ~still if ring == _RINGS else _anchored(faces, free | wider)
    return least_bent(vertices, faces, free), free


def surroundings(
    faces: Int[Tensor, "face 3"], broken: Bool[Tensor, " face"], num_vertices: int
) -> Bool[Tensor, " face"]:
    """Mark the faces round broken ones that :func:`mend` may look at: it needs no others."""
    near = broken
    for _ in range(_RINGS + 3):  # the plate is clamped by two rings, and one tells the border
        near = _corners(faces, near, num_vertices)[faces].any(dim=1)
    return near


def least_bent(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    free: Bool[Tensor, " vertex"],
) -> Float[Tensor, "vertex 3"]:
    r"""Place some vertices where the surface bends least, as a thin plate clamped all round.

    The sum of :math:`\lVert x_i - \tfrac{1}{d_i} \sum_{j \sim i} x_j \rVert^2` over free
    vertices and their neighbours is made as small as can be. Neighbours count alike, whatever
    their distances: those of folded faces mean nothing.

    Args:
        vertices: World.
        faces: Of the surface.
        free: Everything that hangs together of these must have a neighbour that is not free.

    Differentiable in the vertices that are held; one solve.

    Source: Kobbelt, Campagna, Vorsatz, Seidel: Interactive multi-resolution modeling on
    arbitrary meshes, SIGGRAPH 1998, for the energy.
    """
    if not bool(free.any()):
        return vertices
    known = vertices.double()
    ring = _corners(faces, free[faces].any(dim=1), len(vertices))
    edges, _ = face_edges(faces[ring[faces].any(dim=1)])
    links = torch.cat([edges, edges.flip(1)])
    here, there = links[ring[links[:, 0]]].unbind(dim=1)
    (middle,) = torch.nonzero(ring, as_tuple=True)
    degree = torch.bincount(here, minlength=len(vertices)).to(known)
    row = (ring.cumsum(dim=0) - 1)[torch.cat([middle, here])]
    col = torch.cat([middle, there])
    share = torch.cat([torch.ones_like(degree[middle]), -1 / degree[here]])
    unknown = free[col]
    fixed = share[~unknown, None] * known[col[~unknown]]
    target = -known.new_zeros(len(middle), 3).index_add(0, row[~unknown], fixed)
    row, col, share = row[unknown], (free.cumsum(dim=0) - 1)[col[unknown]], share[unknown]
    side = known.new_zeros(int(free.sum()), 3).index_add(0, col, share[:, None] * target[row])
    shape = (len(middle), len(side))
    bending = coo_array((share.cpu().numpy(), (row.cpu().numpy(), col.cpu().numpy())), shape=shape)
    energy = (bending.T @ bending).tocoo()
    rows, cols, values = (
        torch.from_numpy(part).to(side.device) for part in (*energy.coords, energy.data)
    )
    (found,) = solutions(rows.long(), cols.long(), values, side, what="the mending")
    (moved,) = torch.nonzero(free, as_tuple=True)
    return vertices.index_copy(0, moved, found.to(vertices))


def _border(faces: Int[Tensor, "face 3"], num_vertices: int) -> Bool[Tensor, " {num_vertices}"]:
    """Mark vertices on an edge with one face, or more than two."""
    edges, index = face_edges(faces)
    single = torch.bincount(index.flatten(), minlength=len(edges)) != 2
    marked = torch.zeros(num_vertices, dtype=torch.bool, device=faces.device)
    marked[edges[single].flatten()] = True
    return marked


def _corners(
    faces: Int[Tensor, "face 3"], chosen: Bool[Tensor, " face"], num_vertices: int
) -> Bool[Tensor, " {num_vertices}"]:
    """Mark the vertices of some faces."""
    marked = torch.zeros(num_vertices, dtype=torch.bool, device=faces.device)
    marked[faces[chosen].flatten()] = True
    return marked


def _together(
    faces: Int[Tensor, "face 3"], among: Bool[Tensor, " vertex"], some: Bool[Tensor, " vertex"]
) -> Bool[Tensor, " vertex"]:
    """Mark all of every connected group that has some."""
    label = vertex_components(faces, among)
    named = torch.zeros_like(among)
    named[label[among & some]] = True
    return among & named[label]


def _anchored(
    faces: Int[Tensor, "face 3"], free: Bool[Tensor, " vertex"]
) -> Bool[Tensor, " vertex"]:
    """Leave out groups that make up all they hang together with."""
    of_face = free[faces]
    mixed = of_face.any(dim=1) & ~of_face.all(dim=1)
    return _together(faces, free, _corners(faces, mixed, len(free)))
