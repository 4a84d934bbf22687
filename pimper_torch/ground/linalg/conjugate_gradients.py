"""Preconditioned conjugate gradients without a matrix, batched."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.ground.kernels.arrays import as_array
from pimper_torch.ground.linalg.aggregation import parts_of
from pimper_torch.ground.linalg.sums import total
from pimper_torch.runtime.parallel import over_rows


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
        start: Where to begin; zero if not given.
        dims: Of the unknowns of one system; the others are those of the batch.
        tolerance: Of the error's energy norm, as ``precondition`` estimates it, relative to that
            of the solution. Invariant to the scale of A and of any unknown.
        max_iterations: Limit. All systems iterate until the last has converged, or none descends.

    Returns:
        The solutions, the number of iterations, and whether all systems converged.

    Constant to autograd; see :mod:`~pimper_torch.ground.linalg.prepared` for gradients of a
    solution.

    Source: Hestenes & Stiefel, Journal of Research of the NBS 49(6), 1952.
    """

    def inner(one: Tensor, other: Tensor) -> Tensor:
        each = one * other
        if each.dim() == len(dims):  # one system: torch would sum it as threads divide it
            return total(each).reshape((1,) * each.dim())
        return each.sum(dim=dims, keepdim=True)

    found = torch.zeros_like(rhs) if start is None else start.clone()
    residual = rhs.clone() if start is None else rhs - product(found)
    preconditioned = precondition(residual)
    decrease = inner(residual, preconditioned)
    size = decrease if start is None else inner(rhs, precondition(rhs))
    goal = tolerance**2 * size
    direction, steps = preconditioned.clone(), 0
    # Written so that NaN stops the loop, and has not converged.
    while bool((decrease > goal).any()) and steps < max_iterations:
        image = product(direction)
        curvature = inner(direction, image)
        descends = curvature > 0
        if not bool(descends.any()):
            break
        length = torch.where(descends, decrease / curvature, 0)
        found.addcmul_(length, direction)
        residual.addcmul_(length, image, value=-1)
        preconditioned = precondition(residual)
        previous, decrease = decrease, inner(residual, preconditioned)
        growth = torch.where(previous > 0, decrease / previous, 0)
        direction.mul_(growth).add_(preconditioned)
        steps += 1
    return found, steps, bool((decrease.abs() <= goal).all())


@torch.no_grad()
def compressed_gradients(
    matrix: csr_array,
    precondition: Callable[[Float[Tensor, "unknown side"]], Float[Tensor, "unknown side"]],
    rhs: Float[Tensor, "unknown side"],
    *,
    start: Float[Tensor, "unknown side"] | None,
    tolerance: float,
    max_iterations: int,
    dtype: torch.dtype = torch.float64,
) -> tuple[Float[Tensor, "unknown side"], int, bool]:
    """Solve as :func:`conjugate_gradients`, for a matrix in compressed rows, by kernels.

    Args:
        precondition: Approximates the inverse in ``dtype``; it may reuse the memory of its result.
        start: Where to begin; zero if not given.
        dtype: Of the vectors of ``precondition``.
    """
    from pimper_torch.ground.kernels import sparse_products
    from pimper_torch.ground.kernels import vector_updates as kernels

    count, sides = rhs.shape
    blocks = -(-count // kernels.BLOCK)

    def inner(one: Tensor, other: Tensor) -> Tensor:
        sums = torch.empty(blocks, sides, dtype=torch.float64)
        vectors = as_array(one), as_array(other), sums.numpy()
        over_rows(kernels.dots, blocks, *vectors, size=kernels.BLOCK)
        return sums.sum(dim=0)

    def product(vectors: Tensor, base: Tensor, found: Tensor, keep: float, gain: float) -> None:
        arrays = as_array(vectors), as_array(base), as_array(found)
        over_rows(sparse_products.product, count, *parts_of(matrix), *arrays, keep, gain)

    found, residual = torch.zeros_like(rhs), rhs.clone()
    if start is not None:
        found.copy_(start)
        product(found, rhs, residual, 1.0, -1.0)
    rounded = residual.to(dtype, copy=True)
    preconditioned = precondition(rounded)
    decrease = inner(residual, preconditioned)
    direction, image = preconditioned.to(torch.float64, copy=True), torch.empty_like(rhs)
    size = decrease if start is None else inner(rhs, precondition(rounded.copy_(rhs)))
    goal = tolerance**2 * size
    steps = 0
    # Written so that NaN stops the loop, and has not converged.
    while bool((decrease > goal).any()) and steps < max_iterations:
        product(direction, image, image, 0.0, 1.0)
        curvature = inner(direction, image)
        descends = curvature > 0
        if not bool(descends.any()):
            break
        length = torch.where(descends, decrease / curvature, 0).numpy()
        vectors = (as_array(each) for each in (found, residual, direction, image))
        over_rows(kernels.step, count, *vectors, length, rounded.numpy())
        preconditioned = precondition(rounded)
        previous, decrease = decrease, inner(residual, preconditioned)
        growth = torch.where(previous > 0, decrease / previous, 0).numpy()
        over_rows(
            kernels.new_direction, count, as_array(direction), as_array(preconditioned), growth
        )
        steps += 1
    return found, steps, bool((decrease.abs() <= goal).all())
