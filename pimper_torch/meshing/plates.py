"""Parts of a surface replaced by a thin plate, clamped by what surrounds them."""

import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from torch import Tensor

from pimper_torch.geometry.topology import corners_of, face_edges
from pimper_torch.linalg.systems import solutions


def least_bent(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    free: Bool[Tensor, " vertex"],
) -> Float[Tensor, "vertex 3"]:
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
    ring = corners_of(faces, free[faces].any(dim=1), len(vertices))
    edges, _ = face_edges(faces[ring[faces].any(dim=1)])
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
