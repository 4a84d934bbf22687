r"""Gradients at the optimum: how lights and shading answer to the data.

A solver's answer satisfies :math:`\nabla E(x; \theta) = 0`, so that with the Hessian ``H``

.. math:: \frac{dx}{d\theta} = -H^{-1} \frac{\partial \nabla E}{\partial \theta},

whatever way the solver took. One Newton step with ``H`` held constant has just this derivative,
and next to no length. ``H`` is exact: the curvature of the manifold, of the loss and of the
product of lights and shading, and what robust weights owe to the spread of the residuals, are in
it. Samples are eliminated, as in :mod:`~pimper_torch.photometry.variable_projection`.
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
    reweigh,
    root_mean_square,
)
from pimper_torch.photometry.quadratics import (
    apply_packed,
    combination,
    coordinates,
    outer,
    unpacked,
)
from pimper_torch.photometry.robust import Squares
from pimper_torch.records import Record

# Undetermined directions, such as Lorentz transformations of free lights, are regularized by this
# fraction of the mean curvature: the solution moves along none of them.
_RIDGE = 1e-10

# Newton's method doubles the digits of a solution at every step, once it is near; before that its
# steps are halved until they help, down to this fraction.
_NEWTON_STEPS, _MIN_STEP = 30, 1e-3

# Entries of the mixed part of the Hessian that are held at once.
_CHUNK_ENTRIES = 10_000_000


def differentiable(problem: Bilinear, factors: Factors) -> Factors:
    r"""Let gradients flow from a solution to the data it was found from.

    Solvers stop when steps become small; Newton's method first takes the solution to rounding, as
    the implicit function holds at the optimum alone. A patch that its steps do not bring nearer
    stays where it is.

    Args:
        problem: What was solved. Gradients reach ``radiance``, ``anchor``, ``pull`` and ``prior``.
        factors: Its solution, near enough to a minimum that the Hessian is positive.

    Returns:
        Lights, shading, weights and residuals at the optimum, with gradients, those of the robust
        weights and of the deviation they rest on included.

    Checked against the solvers themselves in ``test_implicit.py``. The Hessian is in float64.
    """
    factors = _polished(problem, factors)
    L, N = factors.lights.detach().double(), factors.shading.detach().double()
    hessian = _hessian(problem, L, N)
    step = _newton_step(problem, hessian)
    moved = combination(hessian.columns, step.rotation)
    lights = factors.lights.detach() + (step.lights - step.lights.detach()).to(factors.lights)
    shading = factors.shading.detach() + (moved - moved.detach()).to(factors.shading)
    convergence = factors.convergence
    return factors.replace(
        lights=lights,
        shading=shading,
        weight=reweigh(problem, lights, shading),
        convergence=convergence.replace(residual=root_mean_square(problem, lights, shading)),
    )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Step(Record):
    """A change of all unknowns: of the lights, and of the samples along their tangents."""

    lights: Float[Tensor, "patch view rank"]
    rotation: Float[Tensor, "patch tangent sample"]

    def moved(self, factor: Float[Tensor, " patch"], other: "Step") -> "Step":
        """Add so many times another step."""
        return Step(
            lights=self.lights + factor[:, None, None] * other.lights,
            rotation=self.rotation + factor[:, None, None] * other.rotation,
        )


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


@torch.no_grad()
def _polished(problem: Bilinear, factors: Factors) -> Factors:
    """Take Newton steps, patch by patch, as long as they bring the slopes nearer to zero."""
    hessian = _hessian(problem, factors.lights.double(), factors.shading.double())
    size = _slope_size(problem, hessian)
    fraction = torch.ones_like(size)
    for _ in range(_NEWTON_STEPS):
        step = _newton_step(problem, hessian)
        L = hessian.lights + fraction[:, None, None] * step.lights
        rotation = combination(hessian.columns, fraction[:, None, None] * step.rotation)
        N = problem.manifold.retract((hessian.shading + rotation).mT).mT
        there = _hessian(problem, L, N)
        after = _slope_size(problem, there)
        better = after < size
        fraction = torch.where(better, (2 * fraction).clamp_max(1), fraction / 2)
        if bool(better.any()):
            keep = better[:, None, None]
            L, N = torch.where(keep, L, hessian.lights), torch.where(keep, N, hessian.shading)
            size = torch.where(better, after, size)
            hessian = _hessian(problem, L, N)
        elif bool((fraction < _MIN_STEP).all()):
            break
    return factors.replace(
        lights=hessian.lights.to(factors.lights), shading=hessian.shading.to(factors.shading)
    )


def _slope_size(problem: Bilinear, hessian: Hessian) -> Float[Tensor, " patch"]:
    on_lights, on_samples = _slopes(problem, hessian)
    return on_lights.square().sum(dim=(1, 2)) + on_samples.square().sum(dim=(1, 2))


def _newton_step(problem: Bilinear, hessian: Hessian) -> Step:
    r"""Give the step to where the slopes vanish; differentiable in the data, the Hessian held.

    The deviation :math:`d` that robust weights rest on follows the residuals, which adds one
    product to the Hessian: of the slopes' change with :math:`d`, and of the change of :math:`d`
    with the unknowns. Its inverse is that of Sherman and Morrison.
    """
    step = _solved(hessian, *_slopes(problem, hessian))
    if isinstance(problem.loss, Squares):
        return step
    with torch.no_grad():
        deviation_slope, slopes = _by_deviation(problem, hessian)
        aside = _solved(hessian, *slopes)
        left = 1 - _change_of(deviation_slope, hessian, aside)
    return step.moved(_change_of(deviation_slope, hessian, step) / left, aside)


def _solved(
    hessian: Hessian,
    on_lights: Float[Tensor, "patch view rank"],
    on_samples: Float[Tensor, "patch tangent sample"],
) -> Step:
    """Apply the Hessian's inverse, samples eliminated."""
    inner = _apply(hessian.inverse, on_samples)
    slope = on_lights - _mix(hessian, inner)
    flat = slope.reshape(len(slope), -1, 1)
    lights = torch.linalg.solve(hessian.schur, flat).reshape(slope.shape)
    return Step(lights=lights, rotation=inner - _apply(hessian.inverse, _mix_back(hessian, lights)))


def _by_deviation(
    problem: Bilinear, hessian: Hessian
) -> tuple[
    Float[Tensor, "patch view sample"],
    tuple[Float[Tensor, "patch view rank"], Float[Tensor, "patch tangent sample"]],
]:
    """Give the deviation's derivatives by the residuals, and the slopes' by the deviation."""
    residual = problem.radiance.double() - hessian.lights @ hessian.shading
    with torch.enable_grad():
        at = residual.detach().requires_grad_()
        deviation = deviation_of(problem, at)
        deviation_slope = torch.zeros_like(at)
        if deviation.requires_grad:
            (deviation_slope,) = torch.autograd.grad(deviation.sum(), at)
    # w depends on r / d alone, so that d dw/dd = w - d(w r)/dr: no derivative of it is needed.
    deviation = deviation.detach()[:, None, None].clamp_min(1e-300)
    pulled = (hessian.pulled - hessian.bent * residual) / deviation
    return deviation_slope, (
        pulled @ hessian.shading.mT,
        coordinates(hessian.columns, hessian.lights.mT @ pulled),
    )


def _change_of(
    deviation_slope: Float[Tensor, "patch view sample"], hessian: Hessian, step: Step
) -> Float[Tensor, " patch"]:
    """Give how much a step changes the deviation."""
    shown = step.lights @ hessian.shading
    shown = shown + hessian.lights @ combination(hessian.columns, step.rotation)
    return -(deviation_slope * shown).sum(dim=(1, 2))


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
    regularization = problem.regularization.double()[..., None].expand(-1, -1, rank).flatten(1)
    total = total + torch.diag_embed(regularization)
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
    problem: Bilinear, hessian: Hessian
) -> tuple[Float[Tensor, "patch view rank"], Float[Tensor, "patch tangent sample"]]:
    """Give minus half the gradient, as a function of the data."""
    L, N = hessian.lights, hessian.shading
    residual = problem.radiance.double() - L @ N
    deviation = deviation_of(problem, residual)[:, None, None]
    pulled = problem.weight.double() * problem.loss.weights(residual, deviation) * residual
    difference = L - problem.anchor.double()
    on_lights = pulled @ N.mT - problem.regularization.double()[..., None] * difference
    ambient = L.mT @ pulled
    if problem.prior is not None:
        ambient = ambient - apply_packed(problem.prior.double(), N)
    return on_lights, coordinates(hessian.columns, ambient)


def _mix(
    hessian: Hessian, rotation: Float[Tensor, "patch tangent sample"]
) -> Float[Tensor, "patch view rank"]:
    """Apply the mixed part to changes of the samples."""
    moved = combination(hessian.columns, rotation)
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
