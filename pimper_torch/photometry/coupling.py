r"""Neighbouring patches see nearly the same light.

Every patch has lights of its own, as near lamps, falling off and interreflection differ from
place to place; but not much from one facet to the next:

.. math:: \min_x \sum_\mu x_\mu^\top A_\mu x_\mu - 2 b_\mu^\top x_\mu
          + s \sum_{\mu \mu'} \lVert x_\mu - x_{\mu'} \rVert^2

for each view, in the world frame, with ``A`` and ``b`` what the samples of a patch say of its
light. ``s`` runs from 0, patches by themselves, to infinity, one light for all that hang
together. A patch with few good samples borrows from its neighbours.
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.geometry.components import graph_components
from pimper_torch.linalg.sparse import SparseCholesky

# A patch that no neighbour and no sample tells anything keeps zero: this share of what patches
# know in the mean.
_RIDGE = 1e-9

# Conjugate gradients end at this share of the right-hand side, or after so many steps.
_ACCURACY, _STEPS = 1e-10, 1000

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


def couple_steps(
    curvature: Float[Tensor, "patch unknown unknown"],
    slope: Float[Tensor, "patch view rank"],
    pairs: Int[Tensor, "pair 2"],
    strength: Float[Tensor, " view"],
) -> Float[Tensor, "patch view rank"]:
    """Solve for all lights where a patch's views hang together too, as at a Newton step.

    Args:
        curvature: Of each patch by the lights of all its views, positive; constant.
        slope: Right-hand side.
        pairs: Neighbours.
        strength: As in :func:`couple_lights`.

    Differentiable in the slope. By conjugate gradients, preconditioned patch by patch; with
    infinite strength, directly.
    """
    if bool(strength.isinf().any()):
        component = graph_components(pairs, len(slope))
        count = int(component.max()) + 1
        size = curvature.shape[1]
        total = curvature.new_zeros(count, size, size).index_add(0, component, curvature)
        right = slope.new_zeros(count, *slope.shape[1:]).index_add(0, component, slope)
        found = torch.linalg.solve(total, right.reshape(count, size, 1))
        return found.reshape(right.shape)[component]
    step: Tensor = _Coupled.apply(  # type: ignore[no-untyped-call]
        slope, curvature, pairs, strength
    )
    return step


class _Coupled(torch.autograd.Function):
    """The symmetric solve, its own adjoint."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401 - torch gives contexts no usable type
        slope: Float[Tensor, "patch view rank"],
        curvature: Float[Tensor, "patch unknown unknown"],
        pairs: Int[Tensor, "pair 2"],
        strength: Float[Tensor, " view"],
    ) -> Float[Tensor, "patch view rank"]:
        ctx.save_for_backward(curvature, pairs, strength)
        return _conjugate_gradients(slope, curvature, pairs, strength)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any,  # noqa: ANN401
        upstream: Float[Tensor, "patch view rank"],
    ) -> tuple[Float[Tensor, "..."] | None, ...]:
        return _conjugate_gradients(upstream, *ctx.saved_tensors), None, None, None


def _conjugate_gradients(
    rhs: Float[Tensor, "patch view rank"],
    curvature: Float[Tensor, "patch unknown unknown"],
    pairs: Int[Tensor, "pair 2"],
    strength: Float[Tensor, " view"],
) -> Float[Tensor, "patch view rank"]:
    first, second = pairs[:, 0], pairs[:, 1]
    degree = torch.bincount(pairs.flatten(), minlength=len(rhs)).to(rhs)
    pull = strength[:, None].expand(rhs.shape[1:]).flatten()
    own = curvature + torch.diag_embed(degree[:, None] * pull)
    inverse = torch.linalg.inv(own)

    def apply(x: Tensor) -> Tensor:
        apart = strength[:, None] * (x[first] - x[second])
        coupled = torch.zeros_like(x).index_add(0, first, apart).index_add(0, second, -apart)
        return (curvature @ x.flatten(1)[..., None]).reshape(x.shape) + coupled

    def precondition(x: Tensor) -> Tensor:
        return (inverse @ x.flatten(1)[..., None]).reshape(x.shape)

    found, residual = torch.zeros_like(rhs), rhs
    better = precondition(residual)
    direction, size = better, float((residual * better).sum())
    goal = _ACCURACY**2 * size
    for _ in range(_STEPS):
        if size <= goal or size == 0:
            break
        image = apply(direction)
        length = size / float((direction * image).sum())
        found = found + length * direction
        residual = residual - length * image
        better = precondition(residual)
        before, size = size, float((residual * better).sum())
        direction = better + (size / before) * direction
    return found


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
