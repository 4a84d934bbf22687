r"""Gradients of factorizations by the implicit function theorem.

A solution satisfies :math:`\nabla E(x; \theta) = 0`. With the Hessian ``H``,

.. math:: \frac{dx}{d\theta} = -H^{-1} \frac{\partial \nabla E}{\partial \theta},

for any solver. One Newton step with constant ``H`` has this derivative, and length zero. ``H`` is
exact: it includes the curvature of the manifold, of the loss and of the product of lights and
shading, and the dependence of robust weights on the deviation of the residuals. Samples are
eliminated, as in :mod:`~pimper_torch.stages.photometry.variable_projection`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from pimper_torch.kernels.arrays import as_array
from pimper_torch.kernels.compile import load
from pimper_torch.kernels.switch import compiled_for
from pimper_torch.linalg.robust import Squares, with_slope
from pimper_torch.records import Record
from pimper_torch.stages.photometry import bilinear, quadratics
from pimper_torch.stages.photometry.bilinear import Bilinear, Entries, Factors, Lights, Shading

Tangential = Float[Tensor, "patch tangent sample"]
"""Coordinates of each sample's step along the tangents of the manifold."""

# Relative step of the lights at which Newton's method ends: a choice.
_CONVERGED = 1e-11


def differentiable(problem: Bilinear, factors: Factors) -> Factors:
    """Return the solution of a problem, differentiable in its data.

    Newton's method first refines the solution to rounding, as the implicit function theorem
    holds at the optimum only. A patch keeps its solution if this does not reduce its gradient.

    Args:
        problem: The result is differentiable in its ``radiance``, ``weight``, ``prior_mean``,
            ``regularization`` and ``prior``.
        factors: Its solution, so close to a minimum that the Hessian is positive definite.

    Returns:
        Lights, shading, weights and residuals at the optimum. Gradients include those through the
        robust weights and their scale.

    Checked against the solvers in ``test_factor_gradients.py``. The Hessian is in float64. Where
    the solver is compiled, so are refinement and adjoint
    (:mod:`~pimper_torch.stages.photometry.kernels.factor_adjoint`), and the result is
    differentiable once.
    """
    if problem.has_kernel and compiled_for(problem.radiance.detach()):
        data = problem.radiance, problem.weight, problem.prior_mean, problem.regularization
        lights, shading, weight, residual = _Compiled.apply(  # type: ignore[no-untyped-call]
            problem.detach(), factors, *data, problem.dense_prior
        )
        convergence = factors.convergence.replace(residual=residual)
        return Factors(lights=lights, shading=shading, weight=weight, convergence=convergence)
    exact = problem.to(torch.float64)
    factors = _newton_refined(exact, factors)
    L, N = factors.lights.detach().double(), factors.shading.detach().double()
    hessian = _hessian(exact, L, N)
    step = _newton_step(exact, hessian)
    moved = quadratics.combination(hessian.columns, step.along_tangents)
    lights = factors.lights.detach() + (step.lights - step.lights.detach()).to(factors.lights)
    shading = factors.shading.detach() + (moved - moved.detach()).to(factors.shading)
    residual = bilinear.root_mean_square(problem, lights, shading)
    return factors.replace(
        lights=lights,
        shading=shading,
        weight=bilinear.robust_weights(problem, lights, shading),
        convergence=factors.convergence.replace(residual=residual),
    )


class _Compiled(torch.autograd.Function):
    """The solution of a problem as a function of its data, by the kernel and its adjoint."""

    @staticmethod
    def forward(
        ctx: Any, problem: Bilinear, factors: Factors, *data: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return lights, shading, weights and residuals of the refined solution."""
        load(("factor_adjoint",))
        from pimper_torch.stages.photometry.kernels import factor_adjoint, packed_patches

        code, scale, stride = problem.loss.code, problem.loss.scale, problem.stride
        assert code is not None  # has_kernel
        radiance = data[0].detach().double()
        arrays = (
            factors.lights.detach().to(torch.float64, copy=True).contiguous(),
            factors.shading.detach().to(torch.float64, copy=True).contiguous(),
            torch.zeros_like(radiance, memory_format=torch.contiguous_format),
            radiance.new_zeros(len(radiance)),
        )
        inputs = packed_patches.FactorData(*(as_array(tensor, torch.float64) for tensor in data))
        solution = packed_patches.FactorSolution(*map(as_array, arrays))
        factor_adjoint.refine(inputs, code, scale, stride, solution)
        ctx.loss = code, scale, stride
        ctx.save_for_backward(*arrays[:2], *data)
        lights, shading, weight, residual = (tensor.to(data[0]) for tensor in arrays)
        return lights, shading, weight, residual

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        """Return gradients of the data."""
        from pimper_torch.stages.photometry.kernels import factor_adjoint, packed_patches

        lights, shading, *data = ctx.saved_tensors
        code, scale, stride = ctx.loss
        contiguous, exact = torch.contiguous_format, torch.float64
        gradients = [torch.zeros_like(x, dtype=exact, memory_format=contiguous) for x in data]
        factor_adjoint.pull_back(
            packed_patches.FactorData(*(as_array(tensor, exact) for tensor in data)),
            code,
            scale,
            stride,
            as_array(lights),
            as_array(shading),
            packed_patches.FactorSolution(*(as_array(tensor, exact) for tensor in cotangents)),
            packed_patches.FactorData(*map(as_array, gradients)),
        )
        return None, None, *(tensor.to(data[0]) for tensor in gradients)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FactorStep(Record):
    """A step of all unknowns: the lights, and the samples along their tangents."""

    lights: Lights
    along_tangents: Tangential

    def moved(self, factor: Float[Tensor, " patch"], other: "FactorStep") -> "FactorStep":
        """Return the step plus a multiple of a second one."""
        return FactorStep(
            lights=self.lights + factor[:, None, None] * other.lights,
            along_tangents=self.along_tangents + factor[:, None, None] * other.along_tangents,
        )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Hessian(Record):
    """Half the second derivatives of the objective, constant, samples eliminated.

    Attributes:
        columns: Tangents of the manifold at ``shading``.
        loss_curvature: Weighted second derivative of the loss at each entry.
        weighted_residual: Weight times residual of each entry.
        inverse: Inverse diagonal blocks of the samples.
        inverse_schur: Inverse of the Schur complement for the lights.
    """

    lights: Lights
    shading: Shading
    columns: tuple[Shading, ...]
    loss_curvature: Entries
    weighted_residual: Entries
    inverse: Float[Tensor, "patch sample tangent tangent"]
    inverse_schur: Float[Tensor, "patch unknown unknown"]


@torch.no_grad()
def _newton_refined(problem: Bilinear, factors: Factors) -> Factors:
    """Return factors after Newton steps, which each patch takes if they reduce its gradient."""
    L, N = factors.lights.double(), factors.shading.double()
    norm = _gradient_size(problem, L, N)
    fraction, step = torch.ones_like(norm), _newton_step(problem, _hessian(problem, L, N))
    for _ in range(30):
        moved = quadratics.combination(problem.manifold.tangents(N), step.along_tangents)
        scale = fraction[:, None, None]
        lights = L + scale * step.lights
        shading = problem.manifold.retract((N + scale * moved).mT).mT
        after = _gradient_size(problem, lights, shading)
        better = after < norm
        converged = scale[:, 0, 0] * step.lights.norm(dim=(1, 2)) <= _CONVERGED * L.norm(dim=(1, 2))
        fraction = torch.where(better, (2 * fraction).clamp_max(1), fraction / 2)
        keep = better[:, None, None]
        L, N = torch.where(keep, lights, L), torch.where(keep, shading, N)
        norm = torch.where(better, after, norm)
        if bool((converged | (fraction < 1e-3)).all()):
            break
        if bool(better.any()):
            step = _newton_step(problem, _hessian(problem, L, N))
    return factors.replace(lights=L.to(factors.lights), shading=N.to(factors.shading))


def _gradient_size(problem: Bilinear, L: Lights, N: Shading) -> Float[Tensor, " patch"]:
    on_lights, on_samples = _gradient(problem, L, N, problem.manifold.tangents(N))
    return on_lights.square().sum(dim=(1, 2)) + on_samples.square().sum(dim=(1, 2))


def _newton_step(problem: Bilinear, hessian: Hessian) -> FactorStep:
    r"""Return the Newton step; differentiable in the data with a constant Hessian.

    The scale of the robust weights is a multiple of the residuals' deviation :math:`d`, which
    adds a rank-one term to the Hessian: the derivative of the gradient by :math:`d` times the
    derivative of :math:`d` by the unknowns. The Sherman-Morrison formula inverts the sum.
    """
    point = hessian.lights, hessian.shading, hessian.columns
    step = _solved(hessian, *_gradient(problem, *point))
    if isinstance(problem.loss, Squares):
        return step
    with torch.no_grad():
        deviation_slope, slopes = _by_deviation(problem, hessian)
        deviation_step = _solved(hessian, *slopes)
        remainder = 1 - _change_of(deviation_slope, hessian, deviation_step)
    return step.moved(_change_of(deviation_slope, hessian, step) / remainder, deviation_step)


def _solved(hessian: Hessian, on_lights: Lights, on_samples: Tangential) -> FactorStep:
    """Return the inverse Hessian times a gradient, samples eliminated."""
    inner = _apply(hessian.inverse, on_samples)
    slope = on_lights - _apply_mixed(hessian, inner)
    lights = (hessian.inverse_schur @ slope.reshape(len(slope), -1, 1)).reshape(slope.shape)
    return FactorStep(
        lights=lights,
        along_tangents=inner - _apply(hessian.inverse, _apply_mixed_transpose(hessian, lights)),
    )


def _by_deviation(problem: Bilinear, hessian: Hessian) -> tuple[Entries, tuple[Lights, Tangential]]:
    """Return derivatives of the deviation by residuals, and of the gradient by the deviation."""
    residual = problem.radiance - hessian.lights @ hessian.shading
    deviation, deviation_slope = with_slope(partial(bilinear.residual_deviation, problem), residual)
    # w depends on r / d only, so d dw/dd = w - d(w r)/dr: the derivative of w is not needed.
    deviation = deviation[:, None, None].clamp_min(1e-300)
    weighted_residual = (hessian.weighted_residual - hessian.loss_curvature * residual) / deviation
    return deviation_slope, (
        weighted_residual @ hessian.shading.mT,
        quadratics.coordinates(hessian.columns, hessian.lights.mT @ weighted_residual),
    )


def _change_of(
    deviation_slope: Entries, hessian: Hessian, step: FactorStep
) -> Float[Tensor, " patch"]:
    moved = quadratics.combination(hessian.columns, step.along_tangents)
    samples = step.lights @ hessian.shading + hessian.lights @ moved
    return -(deviation_slope * samples).sum(dim=(1, 2))


@torch.no_grad()
def _hessian(problem: Bilinear, L: Lights, N: Shading) -> Hessian:
    residual, robust = problem.radiance - L @ N, bilinear.robust_weights(problem, L, N)
    deviation = bilinear.residual_deviation(problem, residual)[:, None, None]
    loss_curvature = problem.weight * problem.loss.curvatures(residual, deviation)
    columns = tuple(problem.manifold.tangents(N))
    packed, _ = bilinear.equations_of_samples(problem, L, loss_curvature)
    slope, weighted_residual = -_ambient(problem, L, N, robust), robust * residual
    A, B = quadratics.unpacked(packed, N.shape[1]), torch.stack(columns, dim=-1).transpose(1, 2)
    block = B.mT @ A @ B + problem.manifold.curvature(N, slope)
    hessian = Hessian(
        lights=L,
        shading=N,
        columns=columns,
        loss_curvature=loss_curvature,
        weighted_residual=weighted_residual,
        inverse=_inverse(block),
        inverse_schur=L.new_zeros(len(L), 0, 0),
    )
    return hessian.replace(inverse_schur=_inverse(_schur(problem, hessian)))


def _inverse(matrices: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """Return inverses, zero for singular matrices: samples and patches without data do not move."""
    inverse, info = torch.linalg.inv_ex(matrices)
    regular = (info == 0) & inverse.isfinite().flatten(-2).all(dim=-1)
    return torch.where(regular[..., None, None], inverse, 0)


def _schur(problem: Bilinear, hessian: Hessian) -> Float[Tensor, "patch unknown unknown"]:
    L, N = hessian.lights, hessian.shading
    batch, views, rank = L.shape
    total = bilinear.curvature_of_views(N, hessian.loss_curvature)
    regularization = problem.regularization[..., None].expand(-1, -1, rank).flatten(1)
    total = total + torch.diag_embed(regularization)
    mean = total.diagonal(dim1=1, dim2=2).mean(dim=1)
    size = max(1, 10_000_000 // (batch * views * rank * len(hessian.columns)))
    for first in range(0, N.shape[2], size):
        chunk = slice(first, first + size)
        mixed = torch.stack(
            [
                (hessian.loss_curvature[..., chunk] * (L @ column[..., chunk]))[:, :, None]
                * N[:, None, :, chunk]
                - hessian.weighted_residual[:, :, None, chunk] * column[:, None, :, chunk]
                for column in hessian.columns
            ],
            dim=-1,
        ).flatten(1, 2)
        inverse = hessian.inverse[:, chunk]
        total = total - torch.einsum("pika,pkab,pjkb->pij", mixed, inverse, mixed)
    # Undetermined directions, such as Lorentz transformations of free lights, do not move.
    ridge = 1e-10 * mean.clamp_min(1e-300)
    return total + torch.diag_embed(ridge[:, None].expand(-1, views * rank))


def _gradient(
    problem: Bilinear, L: Lights, N: Shading, columns: Sequence[Shading]
) -> tuple[Lights, Tangential]:
    """Return minus half the gradient by lights and samples, differentiable in the data."""
    robust = bilinear.robust_weights(problem, L, N)
    _, on_lights = bilinear.evaluate(problem, L, N, robust)
    return on_lights, quadratics.coordinates(columns, _ambient(problem, L, N, robust))


def _ambient(problem: Bilinear, L: Lights, N: Shading, robust: Entries) -> Shading:
    """Return minus half the gradient by shading vectors."""
    ambient = L.mT @ (robust * (problem.radiance - L @ N))
    return ambient if problem.prior is None else ambient - quadratics.apply_packed(problem.prior, N)


def _apply_mixed(hessian: Hessian, along_tangents: Tangential) -> Lights:
    moved = quadratics.combination(hessian.columns, along_tangents)
    weighted = hessian.loss_curvature * (hessian.lights @ moved)
    return weighted @ hessian.shading.mT - hessian.weighted_residual @ moved.mT


def _apply_mixed_transpose(hessian: Hessian, step: Lights) -> Tangential:
    weighted = hessian.loss_curvature * (step @ hessian.shading)
    ambient = hessian.lights.mT @ weighted - step.mT @ hessian.weighted_residual
    return quadratics.coordinates(hessian.columns, ambient)


def _apply(
    inverse: Float[Tensor, "patch sample tangent tangent"], vectors: Tangential
) -> Tangential:
    return (inverse @ vectors.mT[..., None])[..., 0].mT
