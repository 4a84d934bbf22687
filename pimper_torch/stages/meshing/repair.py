"""Repair of folds and spikes, by moving their vertices to where the surface bends least.

Faces are unchanged, so a closed surface stays closed.
"""

from collections.abc import Callable

import torch
from scipy.sparse import coo_array

from pimper_torch.geometry import topology
from pimper_torch.geometry.surfaces import side_lengths, vertex_normals
from pimper_torch.linalg.systems import solutions
from pimper_torch.records import Surface
from pimper_torch.records.shapes import FaceMask, Faces, Scalar, VertexMask, Vertices
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.stages.meshing.faults import bounding_diagonal, faults, small_groups
from pimper_torch.stages.stage import Stage


def minimize_bending(vertices: Vertices, faces: Faces, free: VertexMask) -> Vertices:
    r"""Return vertices with free ones moved to where the surface bends least, a clamped thin plate.

    Minimizes the sum of :math:`\lVert x_i - \tfrac{1}{d_i} \sum_{j \sim i} x_j \rVert^2` over
    free vertices and their neighbours, with uniform weights: lengths in folds are meaningless.

    Args:
        free: Vertices to move; every connected component needs a fixed neighbour.

    Differentiable in the fixed vertices; one solve.

    Source: Kobbelt, Campagna, Vorsatz, Seidel: Interactive multi-resolution modeling on
    arbitrary meshes, SIGGRAPH 1998, for the energy.
    """
    if not bool(free.any()):
        return vertices
    positions = vertices.double()
    ring = topology.corners_of(faces, free[faces].any(dim=1), len(vertices))
    edges, _ = topology.face_edges(faces[ring[faces].any(dim=1)])
    links = torch.cat([edges, edges.flip(1)])
    start, end = links[ring[links[:, 0]]].unbind(dim=1)
    (centre,) = torch.nonzero(ring, as_tuple=True)
    degree = torch.bincount(start, minlength=len(vertices)).to(positions)
    row = (ring.cumsum(dim=0) - 1)[torch.cat([centre, start])]
    col = torch.cat([centre, end])
    fraction = torch.cat([torch.ones_like(degree[centre]), -1 / degree[start]])
    unknown = free[col]
    fixed = fraction[~unknown, None] * positions[col[~unknown]]
    target = -positions.new_zeros(len(centre), 3).index_add(0, row[~unknown], fixed)
    row, col, fraction = row[unknown], (free.cumsum(dim=0) - 1)[col[unknown]], fraction[unknown]
    rhs = positions.new_zeros(int(free.sum()), 3).index_add(0, col, fraction[:, None] * target[row])
    shape = (len(centre), len(rhs))
    bending = coo_array(
        (fraction.cpu().numpy(), (row.cpu().numpy(), col.cpu().numpy())), shape=shape
    )
    energy = (bending.T @ bending).tocoo()
    rows, cols, values = (
        torch.from_numpy(array).to(rhs.device) for array in (*energy.coords, energy.data)
    )
    (solution,) = solutions(rows.long(), cols.long(), values, rhs, what="the repairing")
    (moved,) = torch.nonzero(free, as_tuple=True)
    return vertices.index_copy(0, moved, solution.to(vertices))


# Largest diagonal of a repaired component's bounding box, as a fraction of the surface's.
_MAX_EXTENT = 0.1

# Longest edge of a sound face, in multiples of the median.
_MAX_STRETCH = 10.0

# Number of rings of sound vertices by which a defective component may grow, one at a time: with two
# samples per pixel, 6 left 5 openings in a skull's orbit, and 12 none (commit 3dadfd4).
_RINGS = 12


class Repair(Stage):
    """Repair enclosed spikes and folds, before the next scale or extraction.

    Otherwise folds would be transferred to the next scale's templates, and grow there. Repaired
    vertices have confidence 0, and the normals of their new positions.

    Differentiable in the fixed vertices; which vertices move is constant.
    """

    def forward(self, surface: Surface) -> Surface:
        """Return the surface with enclosed defects repaired."""
        vertices, faces = surface.vertices_world, surface.faces
        before = vertices.detach()
        criteria = faults(before, faces, surface.facet, _MAX_STRETCH)
        local, used = criteria.part(surroundings(faces, criteria.broken(before), len(vertices)))
        max_extent = _MAX_EXTENT * bounding_diagonal(before)
        positions, moving = repair(vertices[used], local.faces, local.broken, max_extent)
        vertices = vertices.index_copy(0, used, positions)
        moved = torch.zeros_like(surface.facet, dtype=torch.bool).index_put((used,), moving)
        leave_out("repair", moved, at=before)
        changed = topology.corners_of(faces, moved[faces].any(dim=1), len(vertices))
        return surface.replace(
            vertices_world=vertices,
            normals_world=torch.where(
                changed[:, None], vertex_normals(vertices, faces), surface.normals_world
            ),
            information=torch.where(moved, 0, surface.information),
            height_information=torch.where(moved, 0, surface.height_information),
        )


def repair(
    vertices: Vertices, faces: Faces, broken: Callable[[Vertices], FaceMask], max_extent: Scalar
) -> tuple[Vertices, VertexMask]:
    """Move the vertices of enclosed defective faces until none is defective.

    Each connected component of such vertices moves to where the surface bends least. While it has
    defective faces, it grows by the vertices around it. Components that touch the border, are too
    large, or stay defective are left unchanged.

    Args:
        faces: Of the surface. Edges without two faces are its border.
        broken: Returns the mask of defective faces for positions of the vertices.
        max_extent: Largest diagonal of a component's bounding box after the move.

    Returns:
        The vertices, and the mask of moved ones.

    Differentiable in the fixed vertices; which vertices move is constant.
    """
    before, count = vertices.detach(), len(vertices)
    shortest = 1e-4 * side_lengths(before[faces]).amax(dim=1).median()
    fixed = topology.boundary_vertices(faces, count)
    free = topology.corners_of(faces, broken(before), count)
    free = _with_neighbours(faces, free & ~_components_with(faces, free, fixed))
    for ring in range(_RINGS + 1):
        positions = minimize_bending(before, faces, free)
        fixed = fixed | (free & ~small_groups(positions, faces, free, max_extent))
        free = free & ~fixed
        defective = broken(positions) | (side_lengths(positions[faces]).amax(dim=1) < shortest)
        failed = _components_with(faces, free, topology.corners_of(faces, defective, count))
        if not bool(failed.any()):
            break
        wider = topology.corners_of(faces, failed[faces].any(dim=1), count) & ~fixed
        free = free & ~failed if ring == _RINGS else _with_neighbours(faces, free | wider)
    return minimize_bending(vertices, faces, free), free


def surroundings(faces: Faces, broken: FaceMask, num_vertices: int) -> FaceMask:
    """Return the defective faces and all around them that :func:`repair` may need."""
    # Two more rings clamp the plate, and one shows the border.
    return topology.dilated(faces, broken, _RINGS + 3, num_vertices)


def _components_with(faces: Faces, among: VertexMask, marked: VertexMask) -> VertexMask:
    """Return the connected components of vertices ``among`` that have a marked one."""
    label = topology.vertex_components(faces, among)
    return among & torch.isin(label, label[among & marked])


def _with_neighbours(faces: Faces, free: VertexMask) -> VertexMask:
    """Return the free vertices in connected components with a fixed neighbour."""
    of_face = free[faces]
    mixed = of_face.any(dim=1) & ~of_face.all(dim=1)
    return _components_with(faces, free, topology.corners_of(faces, mixed, len(free)))
