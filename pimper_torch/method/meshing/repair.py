"""Repair of folds and spikes: their vertices move to where the surface bends least.

The faces stay as they are, so that a closed surface stays closed.
"""

from collections.abc import Callable

import torch
from scipy.sparse import coo_array

from pimper_torch.ground.geometry import topology
from pimper_torch.ground.geometry.surfaces import side_lengths, vertex_normals
from pimper_torch.ground.linalg.systems import solutions
from pimper_torch.ground.shapes import FaceMask, Faces, Scalar, VertexMask, Vertices
from pimper_torch.method.meshing.faults import diagonal, faults, small_groups
from pimper_torch.records import Surface
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.stage import Stage


def least_bent(vertices: Vertices, faces: Faces, free: VertexMask) -> Vertices:
    r"""Move some vertices to where the surface bends least, as a thin plate clamped all round.

    Minimizes the sum of :math:`\lVert x_i - \tfrac{1}{d_i} \sum_{j \sim i} x_j \rVert^2` over
    free vertices and their neighbours. Weights are uniform: lengths of folded faces mean
    nothing.

    Args:
        free: Vertices to move; every connected component needs a neighbour that is not free.

    Differentiable in the fixed vertices; one solve.

    Source: Kobbelt, Campagna, Vorsatz, Seidel: Interactive multi-resolution modeling on
    arbitrary meshes, SIGGRAPH 1998, for the energy.
    """
    if not bool(free.any()):
        return vertices
    known = vertices.double()
    ring = topology.corners_of(faces, free[faces].any(dim=1), len(vertices))
    edges, _ = topology.face_edges(faces[ring[faces].any(dim=1)])
    links = torch.cat([edges, edges.flip(1)])
    here, there = links[ring[links[:, 0]]].unbind(dim=1)
    (centre,) = torch.nonzero(ring, as_tuple=True)
    degree = torch.bincount(here, minlength=len(vertices)).to(known)
    row = (ring.cumsum(dim=0) - 1)[torch.cat([centre, here])]
    col = torch.cat([centre, there])
    fraction = torch.cat([torch.ones_like(degree[centre]), -1 / degree[here]])
    unknown = free[col]
    fixed = fraction[~unknown, None] * known[col[~unknown]]
    target = -known.new_zeros(len(centre), 3).index_add(0, row[~unknown], fixed)
    row, col, fraction = row[unknown], (free.cumsum(dim=0) - 1)[col[unknown]], fraction[unknown]
    side = known.new_zeros(int(free.sum()), 3).index_add(0, col, fraction[:, None] * target[row])
    shape = (len(centre), len(side))
    bending = coo_array(
        (fraction.cpu().numpy(), (row.cpu().numpy(), col.cpu().numpy())), shape=shape
    )
    energy = (bending.T @ bending).tocoo()
    rows, cols, values = (
        torch.from_numpy(part).to(side.device) for part in (*energy.coords, energy.data)
    )
    (found,) = solutions(rows.long(), cols.long(), values, side, what="the repairing")
    (moved,) = torch.nonzero(free, as_tuple=True)
    return vertices.index_copy(0, moved, found.to(vertices))


# Diagonal of a repaired component's bounding box, at most, as a fraction of the surface's.
_MAX_EXTENT = 0.1

# Longest edge of a sound face, in multiples of the median.
_MAX_STRETCH = 10.0

# Rings of sound vertices that a component with defects may take in, one at a time: with twice the
# samples a pixel, 6 left 5 openings in a skull's orbit, and 12 none (commit 3dadfd4).
_RINGS = 12


class Repair(Stage):
    """Repair spikes and folds that other faces enclose, before the next scale or the mesh.

    A fold that is left would be transferred to the next scale's templates, and grow there.
    Repaired vertices have no confidence, and the normals of their new positions.

    Differentiable in the vertices that stay; which these are is a constant.
    """

    def forward(self, surface: Surface) -> Surface:
        """Repair what can be repaired."""
        vertices, faces = surface.vertices_world, surface.faces
        before = vertices.detach()
        found = faults(before, faces, surface.facet, _MAX_STRETCH)
        part, used = found.part(surroundings(faces, found.broken(before), len(vertices)))
        farthest = _MAX_EXTENT * diagonal(before)
        positions, moving = repair(vertices[used], part.faces, part.broken, farthest)
        vertices = vertices.index_copy(0, used, positions)
        moved = torch.zeros_like(surface.facet, dtype=torch.bool).index_put((used,), moving)
        leave_out("repair", moved, at=before)
        beside = topology.corners_of(faces, moved[faces].any(dim=1), len(vertices))
        return surface.replace(
            vertices_world=vertices,
            normals_world=torch.where(
                beside[:, None], vertex_normals(vertices, faces), surface.normals_world
            ),
            information=torch.where(moved, 0, surface.information),
            height_information=torch.where(moved, 0, surface.height_information),
        )


def repair(
    vertices: Vertices, faces: Faces, broken: Callable[[Vertices], FaceMask], max_extent: Scalar
) -> tuple[Vertices, VertexMask]:
    """Move the vertices of defective faces that sound ones enclose, until none is defective.

    A connected component of such vertices moves to where the surface bends least; while some
    face there is defective still, it takes in the vertices round it. A component that touches
    the border, or extends too far, or stays defective, is left as it is.

    Args:
        faces: Of the surface. Edges without two of them are its border.
        broken: Marks defective faces, for any position of the vertices.
        max_extent: Diagonal of a component's bounding box, once it has moved.

    Returns:
        The vertices, and which of them were moved.

    Differentiable in the vertices that stay; which these are is a constant.
    """
    before, count = vertices.detach(), len(vertices)
    shortest = 1e-4 * side_lengths(before[faces]).amax(dim=1).median()
    fixed = topology.boundary_vertices(faces, count)
    free = topology.corners_of(faces, broken(before), count)
    free = _with_neighbours(faces, free & ~_components_with(faces, free, fixed))
    for ring in range(_RINGS + 1):
        positions = least_bent(before, faces, free)
        fixed = fixed | (free & ~small_groups(positions, faces, free, max_extent))
        free = free & ~fixed
        wrong = broken(positions) | (side_lengths(positions[faces]).amax(dim=1) < shortest)
        still = _components_with(faces, free, topology.corners_of(faces, wrong, count))
        if not bool(still.any()):
            break
        wider = topology.corners_of(faces, still[faces].any(dim=1), count) & ~fixed
        free = free & ~still if ring == _RINGS else _with_neighbours(faces, free | wider)
    return least_bent(vertices, faces, free), free


def surroundings(faces: Faces, broken: FaceMask, num_vertices: int) -> FaceMask:
    """Find the faces round defective ones that :func:`repair` may use: it needs no others."""
    near = broken
    for _ in range(_RINGS + 3):  # two rings clamp the plate, and one shows the border
        near = topology.corners_of(faces, near, num_vertices)[faces].any(dim=1)
    return near


def _components_with(faces: Faces, among: VertexMask, some: VertexMask) -> VertexMask:
    """Find the connected components of vertices ``among`` that have some of others."""
    label = topology.vertex_components(faces, among)
    return among & torch.isin(label, label[among & some])


def _with_neighbours(faces: Faces, free: VertexMask) -> VertexMask:
    """Leave out connected components without a neighbour that is not free."""
    of_face = free[faces]
    mixed = of_face.any(dim=1) & ~of_face.all(dim=1)
    return _components_with(faces, free, topology.corners_of(faces, mixed, len(free)))
