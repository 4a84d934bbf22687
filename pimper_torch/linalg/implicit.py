"""Gradients of the solution of equations, by the implicit function theorem."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse.linalg import LinearOperator, gmres
from torch import Tensor

# Of the adjoint solution, relative: a choice, far below what finite differences can check.
_TOLERANCE = 1e-10

# Restarts of GMRES and steps in each: choices; a good preconditioner needs some ten steps.
_RESTARTS, _STEPS = 5, 60

# Newton's steps at most, and the smallest fraction of a step in the line search: choices; near the
# solution every step doubles the correct digits.
_NEWTON_STEPS, _MIN_STEP = 8, 0.05

Vector = Float[Tensor, " unknown"]
Array = np.ndarray[tuple[int], np.dtype[np.float64]]


def implicit_solution(
    equations: Callable[[Vector], Vector],
    solution: Vector,
    precondition: Callable[[Vector], Vector],
) -> Vector:
    r"""Make a solution of :math:`g(x; \theta) = 0` differentiable in :math:`\theta`.

    .. math:: \frac{dx}{d\theta} = -\left(\frac{\partial g}{\partial x}\right)^{-1}
              \frac{\partial g}{\partial \theta}

    The adjoint system is solved by GMRES with products from autograd, so that ``g`` may be any
    function. The error of the gradient is of the order of the solution's.

    Args:
        equations: ``g`` as a function of ``x``; gradients reach all else it depends on.
        solution: Where it vanishes. As many unknowns as equations.
        precondition: Product with a symmetric matrix, about the inverse of the derivative by ``x``.

    Returns:
        The solution's values. Float64 on the CPU is used for the adjoint.

    >>> two = torch.tensor([2.0, 3.0], dtype=torch.float64, requires_grad=True)
    >>> root = implicit_solution(lambda x: x**2 - two, two.detach().sqrt(), lambda v: v)
    >>> torch.autograd.grad(root.sum(), two)[0] * two.sqrt() * 2
    tensor([1.0000, 1.0000], dtype=torch.float64, grad_fn=<MulBackward0>)
    """

    def adjoint(upstream: Vector) -> Vector:
        with torch.enable_grad():
            at = solution.detach().requires_grad_()
            residual = equations(at)

        def product(vector: Array) -> Array:
            (found,) = torch.autograd.grad(residual, at, _as(vector, at), retain_graph=True)
            return found.cpu().double().numpy()

        return _solve(product, precondition, upstream)

    answer: Tensor = _Implicit.apply(equations(solution.detach()), solution.detach(), adjoint)  # type: ignore[no-untyped-call]
    return answer


@torch.no_grad()
def newton_solution(
    equations: Callable[[Vector], Vector],
    start: Vector,
    precondition: Callable[[Vector], Vector],
) -> Vector:
    """Refine a solution to rounding by Newton's method with the exact derivative.

    Args:
        start: Near it. Returned if no step reduces the equations' norm.
        precondition: See :func:`implicit_solution`.

    A constant to autograd.
    """
    at, residual = start.detach(), equations(start.detach())
    fraction, close = 1.0, _TOLERANCE * residual.norm()
    for _ in range(_NEWTON_STEPS):
        if bool(residual.norm() <= close):
            break

        def product(vector: Array, at: Vector = at) -> Array:
            found = torch.func.jvp(equations, (at,), (_as(vector, at),))[1]
            return found.cpu().double().numpy()

        step = _solve(product, precondition, residual)
        while fraction > _MIN_STEP:
            trial = at - fraction * step
            new_residual = equations(trial)
            if bool(new_residual.norm() < residual.norm()):
                break
            fraction /= 2
        else:
            return at
        at, residual, fraction = trial, new_residual, min(1.0, 2 * fraction)
    return at


def _solve(
    product: Callable[[Array], Array],
    precondition: Callable[[Vector], Vector],
    rhs: Vector,
) -> Vector:
    def preconditioned(vector: Array) -> Array:
        return precondition(_as(vector, rhs)).detach().cpu().double().numpy()

    shape = (len(rhs), len(rhs))
    found, _ = gmres(
        LinearOperator(shape, matvec=product, dtype=np.float64),
        rhs.detach().cpu().double().numpy(),
        rtol=_TOLERANCE,
        restart=_STEPS,
        maxiter=_RESTARTS,
        M=LinearOperator(shape, matvec=preconditioned, dtype=np.float64),
    )
    return _as(found, rhs)


def _as(vector: Array, like: Tensor) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(vector)).to(like)


class _Implicit(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401 - torch gives contexts no usable type
        residual: Vector,
        solution: Vector,
        adjoint: Callable[[Vector], Vector],
    ) -> Vector:
        ctx.adjoint = adjoint
        return solution.clone()

    @staticmethod
    def backward(
        ctx: Any,  # noqa: ANN401
        upstream: Vector,
    ) -> tuple[Vector, None, None]:
        return -ctx.adjoint(upstream), None, None
