"""Preconditioned conjugate gradients without a matrix, batched."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor


@torch.no_grad()
def conjugate_gradients(
    product: Callable[[Float[Tensor, "*shape"]], Float[Tensor, "*shape"]],
    precondition: Callable[[Float[Tensor, "*shape"]], Float[Tensor, "*shape"]],
    rhs: Float[Tensor, "*shape"],
    *,
    start: Float[Tensor, "*shape"] | None = None,
    dims: tuple[int, ...] = (-1,),
    tolerance: float,
    max_iterations: int,
) -> tuple[Float[Tensor, "*shape"], int, bool]:
    r"""Solve :math:`A x = b` for one or many right-hand sides at once.

    Args:
        product: Of A, symmetric and positive semidefinite.
        precondition: Approximates the inverse of A, symmetric and positive definite too.
        rhs: ``b``.
        start: Where to begin; zero if not given.
        dims: Over which the unknowns of one system run; each place along the others is a
            system of its own.
        tolerance: Of the error's energy norm, as ``precondition`` estimates it, next to that
            of the solution. Scaling A, or any unknown's unit, changes nothing.
        max_iterations: Limit. All systems go on until the last has converged, or none goes down.

    Returns:
        The solutions, products taken on the way, and whether all systems converged.

    Constant to autograd; see :mod:`~pimper_torch.linalg.adjoint` for gradients of a solution.

    Source: Hestenes & Stiefel, Journal of Research of the NBS 49(6), 1952.
    """

    def inner(one: Tensor, other: Tensor) -> Tensor:
        return (one * other).sum(dim=dims, keepdim=True)

    found = torch.zeros_like(rhs) if start is None else start.clone()
    residual = rhs.clone() if start is None else rhs - product(found)
    better = precondition(residual)
    decrease = inner(residual, better)
    size = decrease if start is None else inner(rhs, precondition(rhs))
    goal = tolerance**2 * size
    direction, steps = better.clone(), 0
    # Written so that what is not a number stops the loop and has not converged.
    while bool((decrease > goal).any()) and steps < max_iterations:
        image = product(direction)
        curvature = inner(direction, image)
        descends = curvature > 0
        if not bool(descends.any()):
            break
        length = torch.where(descends, decrease / curvature, 0)
        found.addcmul_(length, direction)
        residual.addcmul_(length, image, value=-1)
        better = precondition(residual)
        previous, decrease = decrease, inner(residual, better)
        growth = torch.where(previous > 0, decrease / previous, 0)
        direction.mul_(growth).add_(better)
        steps += 1
    return found, steps, bool((decrease.abs() <= goal).all())
