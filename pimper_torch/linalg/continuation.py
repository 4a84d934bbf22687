r"""Smooth inpainting of unknown vertex values.

Values vary from vertex to vertex like a random walk and have a weak prior. So the most likely
unknown values minimize

.. math:: \sum_{ab} |v_a - v_b|^2 + \sum_u h_u |v_u - w_u|^2

over edges with an unknown end, and over unknown vertices; ``h`` is the variance of a step over the
prior variance.
"""

import torch

from pimper_torch.geometry.topology import boundary_vertices, vertex_components
from pimper_torch.linalg.sums import average, total
from pimper_torch.linalg.systems import solutions
from pimper_torch.records.shapes import Edges, Faces, PerVertex, VertexMask, VertexValues


def continued(
    values: VertexValues,
    known: VertexMask,
    edges: Edges,
    otherwise: VertexValues,
    damping: PerVertex,
) -> VertexValues:
    """Inpaint unknown vertex values smoothly from known ones.

    Args:
        values: Of the vertices; ignored where unknown.
        edges: Between neighbours, each once.
        otherwise: Prior mean of unknown values, reached far from known ones.
        damping: Weight of the prior mean relative to a neighbour; above 0, or 0 in components with
            a known vertex.

    Differentiable in the known values, and in ``otherwise`` and ``damping`` of the unknown ones.

    >>> chain = torch.tensor([[0, 1], [1, 2], [2, 3], [3, 4]])
    >>> known = torch.tensor([True, True, False, True, True])
    >>> values = torch.tensor([[1.0], [2.0], [9.0], [2.0], [3.0]])
    >>> continued(values, known, chain, 0 * values, torch.full((5,), 1e-9))[2]
    tensor([2.])
    """
    (unknown,) = torch.nonzero(~known, as_tuple=True)
    if len(unknown) == 0:
        return values
    rows = torch.arange(len(unknown), device=known.device)
    index = known.long().index_copy(0, unknown, rows)
    directed = torch.cat([edges, edges.flip(1)])
    vertex, neighbour = directed[~known[directed[:, 0]]].unbind(dim=1)
    row, fixed = index[vertex], known[neighbour]
    row_damping = damping[unknown].double()
    rhs = row_damping[:, None] * otherwise[unknown].double()
    rhs = rhs.index_add(0, row[fixed], values[neighbour[fixed]].double())
    degree = torch.bincount(row, minlength=len(unknown)).to(row_damping)
    (solution,) = solutions(
        torch.cat([rows, row[~fixed]]),
        torch.cat([rows, index[neighbour[~fixed]]]),
        torch.cat([degree + row_damping, degree.new_full((int((~fixed).sum()),), -1.0)]),
        rhs,
        what="the inpainting of vertices",
    )
    return values.index_copy(0, unknown, solution.to(values))


def about_mean(values: VertexValues, known: VertexMask, edges: Edges) -> VertexValues:
    """Inpaint unknown vertex values, with the mean of the known ones as prior mean.

    The variances of a step and of the prior are those of the known values. If none is known,
    ``values`` are returned. Differentiable in the known values.
    """
    if not bool(known.any()):
        return values
    known_values = values[known]
    mean = known_values.mean(dim=0)
    variance = average((known_values - mean).double().square().sum(dim=1))
    start, end = values.double()[edges[known[edges].all(dim=1)]].unbind(dim=1)
    step = total((start - end).square()) / max(len(start), 1)
    damping = torch.where(variance > 0, step / torch.where(variance > 0, variance, 1), 0)
    damping = damping.clamp_min(1e-6).expand(len(values))
    return continued(values, known, edges, mean.expand_as(values), damping)


def enclosed(known: VertexMask, faces: Faces, border: VertexMask | None = None) -> VertexMask:
    """Return the unknown vertices enclosed by known ones: components without a border vertex.

    A component without a known neighbour is not enclosed.

    Args:
        border: Border vertices of the surface; those of the faces by default.

    >>> fan = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1]])
    >>> enclosed(torch.tensor([False, True, True, True]), fan)
    tensor([ True, False, False, False])
    """
    label = vertex_components(faces, ~known)
    if border is None:
        border = boundary_vertices(faces, len(known))
    at_border = torch.zeros(len(known), dtype=torch.bool, device=known.device)
    at_border[label[border & ~known]] = True
    corner = known[faces]
    ends = faces[corner.any(dim=1)[:, None] & ~corner]
    has_known = torch.zeros_like(at_border)
    has_known[label[ends]] = True
    return ~known & has_known[label] & ~at_border[label]
