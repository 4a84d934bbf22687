r"""Gradients at the optimum: how lights and shading answer to the data.

A solver's answer satisfies :math:`\nabla E(x; \theta) = 0`, so that with the Hessian ``H``

.. math:: \frac{dx}{d\theta} = -H^{-1} \frac{\partial \nabla E}{\partial \theta},

whatever way the solver took. One Newton step with ``H`` held constant has just this derivative,
and next to no length. ``H`` is exact: the curvature of the manifold, of the loss and of the
product of lights and shading are in it. Samples are eliminated, as in
:mod:`~pimper_torch.photometry.variable_projection`.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.photometry.bilinear import (
    Bilinear,
    Factors,
    curvature_of_views,
    deviation_of,
)
from pimper_torch.photometry.quadratics import (
    apply_packed,
    combination,
    coordinates,
    outer,
    unpacked,
)
from pimper_torch.records import Record

# Directions that nothing determines, such as Lorentz transformations of free lights, are held by
# this share of the mean curvature: the answer moves along none of them.
_RIDGE = 1e-10

# Entries of the mixed part of the Hessian that are held at once.
_CHUNK_ENTRIES = 10_000_000


def differentiable(problem: Bilinear, factors: Factors) -> Factors:
    r"""Let gradients flow from a solution to the data it was found from.

    Args:
        problem: What was solved. Gradients reach ``radiance``, ``weight``, ``anchor``, ``pull``
            and ``prior``.
        factors: Its solution, near enough to a minimum that the Hessian is positive.

    Returns:
        The same values, with gradients. Of a robust loss the deviation of the residuals is
        constant, the weights are not. In float64.

    Checked by ``gradcheck`` against the solvers themselves in ``test_implicit.py``.
    """
    system = eliminated(problem, factors)
    size = system.slope.shape[1] * system.slope.shape[2]
    flat = system.slope.reshape(-1, size, 1)
    step = torch.linalg.solve(system.hessian.schur, flat).reshape(system.slope.shape)
    return answered(factors, system, step)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Hessian(Record):
    """Half the second derivatives of the objective, constant, samples eliminated.

    Attributes:
        lights: Where it was taken.
        shading: Where it was taken.
        columns: The manifold's tangents there.
        bent: What each entry's square counts there: the loss's second derivative.
        pulled: Each entry's weighted residual.
        inverse: Of the samples' own part.
        schur: What is left for the lights.
    """

    lights: Float[Tensor, "patch view rank"]
    shading: Float[Tensor, "patch rank sample"]
    columns: tuple[Float[Tensor, "patch rank sample"], ...]
    bent: Float[Tensor, "patch view sample"]
    pulled: Float[Tensor, "patch view sample"]
    inverse: Float[Tensor, "patch sample tangent tangent"]
    schur: Float[Tensor, "patch unknown unknown"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Eliminated(Record):
    """The Newton step at a solution, as equations for the lights alone.

    Attributes:
        hessian: Constant; its ``schur`` times the step of the lights is the slope.
        slope: What the data say to the lights; zero at the optimum, but not its derivative.
        inner: What they say to the samples, lights held.
    """

    hessian: Hessian
    slope: Float[Tensor, "patch view rank"]
    inner: Float[Tensor, "patch tangent sample"]


def eliminated(problem: Bilinear, factors: Factors) -> Eliminated:
    """Set the equations up; differentiable in the data, with the Hessian held constant."""
    L, N = factors.lights.detach().double(), factors.shading.detach().double()
    hessian = _hessian(problem, L, N)
    on_lights, on_samples = _slopes(problem, hessian, L, N)
    inner = _apply(hessian.inverse, on_samples)
    return Eliminated(hessian=hessian, slope=on_lights - _mix(hessian, inner), inner=inner)


def answered(
    factors: Factors, system: Eliminated, step: Float[Tensor, "patch view rank"]
) -> Factors:
    """Give the solution the derivatives of a step of the lights, and of the samples after it."""
    hessian = system.hessian
    turn = system.inner - _apply(hessian.inverse, _mix_back(hessian, step))
    moved = combination(hessian.columns, turn)
    return factors.replace(
        lights=factors.lights.detach() + (step - step.detach()).to(factors.lights),
        shading=factors.shading.detach() + (moved - moved.detach()).to(factors.shading),
    )


@torch.no_grad()
def _hessian(
    problem: Bilinear, L: Float[Tensor, "patch view rank"], N: Float[Tensor, "patch rank sample"]
) -> Hessian:
    weight, radiance = problem.weight.double(), problem.radiance.double()
    residual = radiance - L @ N
    deviation = deviation_of(problem, residual)[:, None, None]
    pulled = weight * problem.loss.weights(residual, deviation) * residual
    bent = weight * problem.loss.curvatures(residual, deviation)
    columns = tuple(problem.manifold.tangents(N))
    packed, slope = outer(L.mT) @ bent, -(L.mT @ pulled)
    if problem.prior is not None:
        prior = problem.prior.double()
        packed, slope = packed + prior, slope + apply_packed(prior, N)
    A, B = unpacked(packed, N.shape[1]), torch.stack(columns, dim=-1).transpose(1, 2)
    own = B.mT @ A @ B + problem.manifold.curvature(N, slope)
    diagonal = own.diagonal(dim1=2, dim2=3).abs().sum(dim=-1)
    eye = torch.eye(own.shape[-1], dtype=own.dtype, device=own.device)
    # A sample that no view has answers to nothing.
    own = torch.where((diagonal > 0)[..., None, None], own, eye)
    inverse = torch.linalg.inv_ex(own).inverse
    found = Hessian(
        lights=L,
        shading=N,
        columns=columns,
        bent=bent,
        pulled=pulled,
        inverse=inverse,
        schur=L.new_zeros(len(L), 0, 0),
    )
    return found.replace(schur=_schur(problem, found))


def _schur(problem: Bilinear, hessian: Hessian) -> Float[Tensor, "patch unknown unknown"]:
    L, N = hessian.lights, hessian.shading
    batch, views, rank = L.shape
    total = curvature_of_views(N, hessian.bent)
    pull = problem.pull.double()[..., None].expand(-1, -1, rank).flatten(1)
    total = total + torch.diag_embed(pull)
    mean = total.diagonal(dim1=1, dim2=2).mean(dim=1)
    size = max(1, _CHUNK_ENTRIES // (batch * views * rank * len(hessian.columns)))
    for first in range(0, N.shape[2], size):
        part = slice(first, first + size)
        mixed = torch.stack(
            [
                (hessian.bent[..., part] * (L @ column[..., part]))[:, :, None]
                * N[:, None, :, part]
                - hessian.pulled[:, :, None, part] * column[:, None, :, part]
                for column in hessian.columns
            ],
            dim=-1,
        ).flatten(1, 2)
        total = total - mixed.flatten(2) @ (
            (mixed[..., None, :] @ hessian.inverse[:, None, part])[..., 0, :].flatten(2).mT
        )
    ridge = _RIDGE * mean.clamp_min(1e-300)
    return total + torch.diag_embed(ridge[:, None].expand(-1, views * rank))


def _slopes(
    problem: Bilinear,
    hessian: Hessian,
    L: Float[Tensor, "patch view rank"],
    N: Float[Tensor, "patch rank sample"],
) -> tuple[Float[Tensor, "patch view rank"], Float[Tensor, "patch tangent sample"]]:
    """Give minus half the gradient, as a function of the data."""
    residual = problem.radiance.double() - L @ N
    deviation = deviation_of(problem, residual).detach()[:, None, None]
    pulled = problem.weight.double() * problem.loss.weights(residual, deviation) * residual
    apart = L - problem.anchor.double()
    on_lights = pulled @ N.mT - problem.pull.double()[..., None] * apart
    ambient = L.mT @ pulled
    if problem.prior is not None:
        ambient = ambient - apply_packed(problem.prior.double(), N)
    return on_lights, coordinates(hessian.columns, ambient)


def _mix(
    hessian: Hessian, turn: Float[Tensor, "patch tangent sample"]
) -> Float[Tensor, "patch view rank"]:
    """Apply the mixed part to changes of the samples."""
    moved = combination(hessian.columns, turn)
    return (
        hessian.bent * (hessian.lights @ moved)
    ) @ hessian.shading.mT - hessian.pulled @ moved.mT


def _mix_back(
    hessian: Hessian, step: Float[Tensor, "patch view rank"]
) -> Float[Tensor, "patch tangent sample"]:
    """Apply its transpose to changes of the lights."""
    ambient = hessian.lights.mT @ (hessian.bent * (step @ hessian.shading)) - (
        step.mT @ hessian.pulled
    )
    return coordinates(hessian.columns, ambient)


def _apply(
    inverse: Float[Tensor, "patch sample tangent tangent"],
    vectors: Float[Tensor, "patch tangent sample"],
) -> Float[Tensor, "patch tangent sample"]:
    return (inverse @ vectors.mT[..., None])[..., 0].mT
