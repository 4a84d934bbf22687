r"""Neighbouring patches see nearly the same light.

Every patch has lights of its own, as near lamps, falling off and interreflection differ from
place to place; but not much from one facet to the next:

.. math:: \min_x \sum_\mu x_\mu^\top A_\mu x_\mu - 2 b_\mu^\top x_\mu
          + s \sum_{\mu \mu'} \lVert x_\mu - x_{\mu'} \rVert^2

for each view, in the world frame, with ``A`` and ``b`` what the samples of a patch say of its
light. ``s`` runs from 0, patches by themselves, to infinity, one light for all that hang
together. A patch with few good samples borrows from its neighbours.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.components import graph_components
from pimper_torch.linalg.sparse import SparseCholesky

# A patch that no neighbour and no sample tells anything keeps zero: this share of what patches
# know in the mean.
_RIDGE = 1e-9

# From this many times what a patch knows of its light coupling is infinite: the lights differ by
# less than single precision, and the equations lose their digits.
_AS_ONE = 1e8


def couple_lights(
    information: Float[Tensor, "patch view rank rank"],
    rhs: Float[Tensor, "patch view rank"],
    pairs: Int[Tensor, "pair 2"],
    strength: Float[Tensor, " view"],
) -> Float[Tensor, "patch view rank"]:
    """Solve for the lights of all patches, one sparse system a view.

    Args:
        information: ``A``, symmetric, not negative.
        rhs: ``b``.
        pairs: Neighbours.
        strength: ``s`` of each view; infinity allowed.

    Differentiable in ``information`` and ``rhs``, and in finite ``strength``. In float64.
    """
    num_patches, num_views, rank = rhs.shape
    A, b = information.double(), rhs.double()
    level = A.diagonal(dim1=2, dim2=3).detach().mean(dim=(0, 2)).clamp_min(1e-300)
    eye = torch.eye(rank, dtype=A.dtype, device=A.device)
    A = A + _RIDGE * level[:, None, None] * eye
    component = graph_components(pairs, num_patches)
    lights = []
    for view in range(num_views):
        if bool(strength[view].detach() >= _AS_ONE * level[view]):
            lights.append(_one_light(A[:, view], b[:, view], component))
        else:
            lights.append(_coupled(A[:, view], b[:, view], pairs, strength[view].double()))
    return torch.stack(lights, dim=1).to(rhs.dtype)


def disagreement(
    lights: Float[Tensor, "patch view rank"], pairs: Int[Tensor, "pair 2"]
) -> Float[Tensor, " view"]:
    r"""Give :math:`\sum \lVert x_\mu - x_{\mu'} \rVert^2` of each view."""
    apart = lights[pairs[:, 0]] - lights[pairs[:, 1]]
    return apart.square().sum(dim=(0, 2))


def _one_light(
    A: Float[Tensor, "patch rank rank"],
    b: Float[Tensor, "patch rank"],
    component: Int[Tensor, " patch"],
) -> Float[Tensor, "patch rank"]:
    count = int(component.max()) + 1 if len(component) else 0
    total = A.new_zeros(count, *A.shape[1:]).index_add(0, component, A)
    right = b.new_zeros(count, b.shape[1]).index_add(0, component, b)
    return torch.linalg.solve(total, right)[component]


def _coupled(
    A: Float[Tensor, "patch rank rank"],
    b: Float[Tensor, "patch rank"],
    pairs: Int[Tensor, "pair 2"],
    strength: Float[Tensor, ""],
) -> Float[Tensor, "patch rank"]:
    count, rank = b.shape
    device = b.device
    first, second = pairs[:, 0], pairs[:, 1]
    degree = torch.bincount(pairs.flatten(), minlength=count).to(A)
    axis = torch.arange(rank, device=device)
    unknown = rank * torch.arange(count, device=device)[:, None] + axis
    block_rows = unknown[:, :, None].expand(-1, -1, rank).flatten()
    block_cols = unknown[:, None, :].expand(-1, rank, -1).flatten()
    own = A + strength * torch.diag_embed(degree[:, None].expand(-1, rank))
    across = (-strength).expand(rank * len(pairs))
    here, there = unknown[first].flatten(), unknown[second].flatten()
    factor = SparseCholesky(
        torch.cat([block_rows, here, there]),
        torch.cat([block_cols, there, here]),
        torch.cat([own.flatten(), across, across]),
        size=count * rank,
        what="the coupling of lights",
    )
    return factor.solve(b.flatten()).reshape(count, rank)
