r"""What is known of some vertices, continued onto the others.

Values vary from vertex to vertex like a random walk about their mean, so that the most likely
ones of the others minimize

.. math:: \sum_{ab} |v_a - v_b|^2 / \tau^2 + \sum_u |v_u - \bar v|^2 / \sigma^2

over edges that end in one of them, and over them. Both variances are those of the known values.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.surfaces import face_edges
from pimper_torch.linalg.systems import solutions

# The mean counts as much as this share of a neighbour at least, so that every vertex has a value.
_LEAST_HOLD = 1e-6


def continued(
    values: Float[Tensor, "vertex channel"],
    known: Bool[Tensor, " vertex"],
    faces: Int[Tensor, "face 3"],
) -> Float[Tensor, "vertex channel"]:
    """Continue values from where they are known: smoothly near by, to their mean further away.

    Args:
        values: Of the vertices; anything where they are not known.
        known: Where they are. If nowhere, ``values`` are returned.
        faces: Whose edges have neighbours for ends.

    Differentiable in the values that are known.

    >>> strip = torch.tensor([[0, 1, 2], [1, 2, 3], [2, 3, 4]])
    >>> known = torch.tensor([True, True, False, True, True])
    >>> continued(torch.tensor([[1.0], [1.0], [9.0], [1.0], [1.0]]), known, strip).flatten()
    tensor([1., 1., 1., 1., 1.])
    """
    (unknown,) = torch.nonzero(~known, as_tuple=True)
    if len(unknown) == 0 or len(unknown) == len(known):
        return values
    edges, _ = face_edges(faces)
    given = values[known].double()
    mean, hold = given.mean(dim=0), _hold(values.detach().double(), known, edges)
    each = torch.arange(len(unknown), device=known.device)
    number = known.long().index_copy(0, unknown, each)
    both = torch.cat([edges, edges.flip(1)])
    own, beside = both[~known[both[:, 0]]].unbind(dim=1)
    row, fixed = number[own], known[beside]
    side = (hold * mean).expand(len(unknown), -1)
    side = side.index_add(0, row[fixed], values[beside[fixed]].double())
    around = torch.bincount(row, minlength=len(unknown)).to(side)
    (found,) = solutions(
        torch.cat([each, row[~fixed]]),
        torch.cat([each, number[beside[~fixed]]]),
        torch.cat([around + hold, around.new_full((int((~fixed).sum()),), -1.0)]),
        side,
        what="the continuation of what is known of some vertices",
    )
    return values.index_copy(0, unknown, found.to(values))


def _hold(
    values: Float[Tensor, "vertex channel"],
    known: Bool[Tensor, " vertex"],
    edges: Int[Tensor, "edge 2"],
) -> float:
    """Give the variance of a step over that of the values."""
    one, other = values[edges[known[edges].all(dim=1)]].unbind(dim=1)
    step = float((one - other).square().sum(dim=1).mean()) if len(one) else 0.0
    given = values[known]
    spread = float((given - given.mean(dim=0)).square().sum(dim=1).mean())
    return max(step / spread if spread > 0 else 0.0, _LEAST_HOLD)
