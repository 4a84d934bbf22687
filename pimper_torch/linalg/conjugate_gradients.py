"""Conjugate gradients preconditioned by multigrid cycles, for several right-hand sides."""

import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor

from pimper_torch.kernels.arrays import as_array
from pimper_torch.linalg.aggregation import parts_of
from pimper_torch.linalg.hierarchy import Hierarchy
from pimper_torch.runtime.parallel import over_rows


@torch.no_grad()
def compressed_gradients(
    matrix: csr_array,
    hierarchy: Hierarchy,
    rhs: Float[Tensor, "unknown side"],
    *,
    start: Float[Tensor, "unknown side"] | None,
    tolerance: float,
    max_iterations: int,
) -> tuple[Float[Tensor, "unknown side"], int, bool]:
    r"""Solve :math:`A x = b` for all right-hand sides together, in float64 on the CPU.

    Not differentiable; :mod:`~pimper_torch.linalg.prepared` has gradients of solutions.

    Args:
        matrix: A, symmetric and positive definite.
        start: Initial solution; zero if ``None``.
        tolerance: Maximum energy norm of the error, as estimated by the hierarchy, relative to that
            of the solution. Invariant to the scale of A and of any unknown.
        max_iterations: Limit. All systems iterate until the last has converged, or none descends.

    Returns:
        The solutions, the number of iterations, and whether all systems converged.

    Source: Hestenes & Stiefel, Journal of Research of the NBS 49(6), 1952.
    """
    from pimper_torch.kernels import sparse_products
    from pimper_torch.kernels import vector_updates as kernels

    count, sides = rhs.shape
    blocks = -(-count // kernels.BLOCK)

    def inner(a: Tensor, b: Tensor) -> Tensor:
        sums = torch.empty(blocks, sides, dtype=torch.float64)
        vectors = as_array(a), as_array(b), sums.numpy()
        over_rows(kernels.dots, blocks, *vectors, size=kernels.BLOCK)
        return sums.sum(dim=0)

    def product(vectors: Tensor, base: Tensor, out: Tensor, keep: float, gain: float) -> None:
        arrays = as_array(vectors), as_array(base), as_array(out)
        over_rows(sparse_products.product, count, *parts_of(matrix), *arrays, keep, gain)

    solution, residual = torch.zeros_like(rhs), rhs.clone()
    if start is not None:
        solution.copy_(start)
        product(solution, rhs, residual, 1.0, -1.0)
    rounded = residual.to(hierarchy.dtype, copy=True)
    preconditioned = hierarchy.cycle(rounded)
    decrease = inner(residual, preconditioned)
    direction, image = preconditioned.to(torch.float64, copy=True), torch.empty_like(rhs)
    size = decrease if start is None else inner(rhs, hierarchy.cycle(rounded.copy_(rhs)))
    goal = tolerance**2 * size
    steps = 0
    # NaN stops the loop and counts as not converged.
    while bool((decrease > goal).any()) and steps < max_iterations:
        product(direction, image, image, 0.0, 1.0)
        curvature = inner(direction, image)
        descends = curvature > 0
        if not bool(descends.any()):
            break
        length = torch.where(descends, decrease / curvature, 0).numpy()
        vectors = (as_array(each) for each in (solution, residual, direction, image))
        over_rows(kernels.step, count, *vectors, length, rounded.numpy())
        preconditioned = hierarchy.cycle(rounded)
        previous, decrease = decrease, inner(residual, preconditioned)
        growth = torch.where(previous > 0, decrease / previous, 0).numpy()
        vectors = (as_array(each) for each in (direction, preconditioned))
        over_rows(kernels.new_direction, count, *vectors, growth)
        steps += 1
    return solution, steps, bool((decrease.abs() <= goal).all())
