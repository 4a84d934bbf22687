r"""Values of some vertices, inpainted on the others.

Values vary from vertex to vertex like a random walk, and are known, badly, from elsewhere, so
that the most likely ones of the others minimize

.. math:: \sum_{ab} |v_a - v_b|^2 + \sum_u h_u |v_u - w_u|^2

over edges that end in one of them, and over them; ``h`` is the variance of a step over that of
what is known from elsewhere.
"""

import torch

from pimper_torch.ground.geometry.topology import boundary_vertices, vertex_components
from pimper_torch.ground.linalg.sums import average, total
from pimper_torch.ground.linalg.systems import solutions
from pimper_torch.ground.shapes import Edges, Faces, PerVertex, VertexMask, VertexValues


def continued(
    values: VertexValues,
    known: VertexMask,
    edges: Edges,
    otherwise: VertexValues,
    damping: PerVertex,
) -> VertexValues:
    """Continue values smoothly from where they are known.

    Args:
        values: Of the vertices; anything where they are not known.
        edges: Between neighbours, each once.
        otherwise: What the others are taken for, far from what is known.
        damping: How many neighbours that counts as; above 0 unless all have a known one, or one
            that has.

    Differentiable in the values that are known, and in the others' ``otherwise`` and ``damping``.

    >>> chain = torch.tensor([[0, 1], [1, 2], [2, 3], [3, 4]])
    >>> known = torch.tensor([True, True, False, True, True])
    >>> values = torch.tensor([[1.0], [2.0], [9.0], [2.0], [3.0]])
    >>> continued(values, known, chain, 0 * values, torch.full((5,), 1e-9))[2]
    tensor([2.])
    """
    (unknown,) = torch.nonzero(~known, as_tuple=True)
    if len(unknown) == 0:
        return values
    each = torch.arange(len(unknown), device=known.device)
    index = known.long().index_copy(0, unknown, each)
    both = torch.cat([edges, edges.flip(1)])
    own, beside = both[~known[both[:, 0]]].unbind(dim=1)
    row, fixed = index[own], known[beside]
    own_damping = damping[unknown].double()
    side = own_damping[:, None] * otherwise[unknown].double()
    side = side.index_add(0, row[fixed], values[beside[fixed]].double())
    around = torch.bincount(row, minlength=len(unknown)).to(own_damping)
    (found,) = solutions(
        torch.cat([each, row[~fixed]]),
        torch.cat([each, index[beside[~fixed]]]),
        torch.cat([around + own_damping, around.new_full((int((~fixed).sum()),), -1.0)]),
        side,
        what="the inpainting of vertices",
    )
    return values.index_copy(0, unknown, found.to(values))


def about_mean(values: VertexValues, known: VertexMask, edges: Edges) -> VertexValues:
    """Continue values from where they are known; far from there, they are the mean of these.

    Both variances are those of the known values. If none is known, ``values`` are returned.
    Differentiable in the known values.
    """
    if not bool(known.any()):
        return values
    given = values[known]
    mean = given.mean(dim=0)
    spread = average((given - mean).double().square().sum(dim=1))
    one, other = values.double()[edges[known[edges].all(dim=1)]].unbind(dim=1)
    step = total((one - other).square()) / max(len(one), 1)
    damping = torch.where(spread > 0, step / torch.where(spread > 0, spread, 1), 0)
    damping = damping.clamp_min(1e-6).expand(len(values))
    return continued(values, known, edges, mean.expand_as(values), damping)


def enclosed(known: VertexMask, faces: Faces, border: VertexMask | None = None) -> VertexMask:
    """Find what known vertices enclose: groups of others that do not reach the border.

    A group without any known vertex beside it is not enclosed.

    Args:
        border: Of the surface; without, that of the faces.

    >>> fan = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1]])
    >>> enclosed(torch.tensor([False, True, True, True]), fan)
    tensor([ True, False, False, False])
    """
    label = vertex_components(faces, ~known)
    if border is None:
        border = boundary_vertices(faces, len(known))
    reaches = torch.zeros(len(known), dtype=torch.bool, device=known.device)
    reaches[label[border & ~known]] = True
    corner = known[faces]
    ends = faces[corner.any(dim=1)[:, None] & ~corner]
    beside = torch.zeros_like(reaches)
    beside[label[ends]] = True
    return ~known & beside[label] & ~reaches[label]
