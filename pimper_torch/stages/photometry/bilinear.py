r"""The bilinear problem that every solver solves: lights and shading vectors from radiance.

.. math::

    \min_{L, N} \sum_{fk} D_{fk}\, \phi(J_{fk} - l_f^\top n_k)
    + \sum_f c_f \lVert l_f - \bar l_f \rVert^2
    + \sum_k n_k^\top P_k n_k
    \quad \text{with } n_k \in \mathcal M

for every patch of a batch, with ``M`` the photometric manifold for an order of lighting and
:math:`\phi` a loss. With ``c = 0``, ``P = 0``, squares and the cone this is the published
problem; with a linear manifold it is low-rank factorization with missing data.

A solver is a function of a problem, a maximum number of iterations and a tolerance. It iterates
over a batch of patches until each has stopped (:func:`iterate`).
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.kernels.twin_constants import MAX_STEP, MIN_DEVIATION
from pimper_torch.linalg.robust import Loss, Squares, robust_deviation
from pimper_torch.records import Convergence, Record, StopCause
from pimper_torch.stages.photometry import quadratics
from pimper_torch.stages.photometry.cone import Cone, Manifold

Lights = Float[Tensor, "patch view rank"]
Shading = Float[Tensor, "patch rank sample"]
Entries = Float[Tensor, "patch view sample"]
"""A value for each view of each sample, such as its radiance or weight."""
Packed = Float[Tensor, "patch packed sample"]
"""A symmetric matrix for each sample, see :mod:`~pimper_torch.stages.photometry.quadratics`."""

# Steps between updates of the robust weights: they change slowly, and estimating the scale of the
# residuals takes as long as a step.
REWEIGHT_EVERY = 3


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Bilinear(Record):
    """A batch of factorization problems, the samples of each patch flattened and padded.

    Attributes:
        radiance: ``J``, zero where missing.
        weight: ``D``, the weight of each entry; 0 where missing.
        lights: Initial ``L``.
        prior_mean: Prior mean of the lights.
        shading: Initial ``N``, columns on the manifold.
        regularization: ``c_f``, weight of the lights' prior per view.
        prior: ``P``, packed: prior of the shading vectors, such as
            :meth:`~pimper_torch.stages.photometry.cone.Cone.normal_prior`; ``None`` for none.
        manifold: Set of possible shading vectors.
        loss: Loss of the residuals; their deviation is estimated per patch.
        stride: The deviation is estimated from every ``stride``-th sample.
    """

    radiance: Entries
    weight: Entries
    lights: Lights
    prior_mean: Lights
    shading: Shading
    regularization: Float[Tensor, "patch view"]
    prior: Packed | None = None
    manifold: Manifold = Cone()  # noqa: RUF009 - frozen
    loss: Loss = Squares()  # noqa: RUF009 - frozen
    stride: int = 1

    @property
    def requires_grad(self) -> bool:
        """Whether gradients of the solution are required."""
        data = (self.radiance, self.weight, self.prior_mean, self.regularization, self.prior)
        return any(tensor is not None and tensor.requires_grad for tensor in data)

    @property
    def has_kernel(self) -> bool:
        """Whether compiled kernels support its manifold and loss."""
        return isinstance(self.manifold, Cone) and self.loss.code is not None

    @property
    def dense_prior(self) -> Packed:
        """``P``, zeros if ``None``, as kernels require."""
        patches, _, samples = self.radiance.shape
        return self.radiance.new_zeros(patches, 10, samples) if self.prior is None else self.prior


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Factors(Record):
    """The solution of a :class:`Bilinear` problem.

    Attributes:
        lights: ``L``.
        shading: ``N``, columns on the manifold.
        weight: ``D`` times the final robust weights.
    """

    lights: Lights
    shading: Shading
    weight: Entries
    convergence: Convergence


Solver = Callable[[Bilinear, int, float], Factors]


def robust_weights(problem: Bilinear, lights: Lights, shading: Shading) -> Entries:
    """Return ``D`` times the weights of the loss at the current residuals."""
    if isinstance(problem.loss, Squares):
        return problem.weight
    residual = problem.radiance - lights @ shading
    deviation = residual_deviation(problem, residual)
    return problem.weight * problem.loss.weights(residual, deviation[:, None, None])


def equations_of_samples(
    problem: Bilinear, lights: Lights, weight: Entries
) -> tuple[Packed, Shading]:
    """Return the normal equations for every sample's shading vector, given the lights."""
    packed = quadratics.outer(lights.mT) @ weight
    if problem.prior is not None:
        packed = packed + problem.prior
    return packed, lights.mT @ (weight * problem.radiance)


def equations_of_views(
    problem: Bilinear, shading: Shading, weight: Entries
) -> tuple[Float[Tensor, "patch packed view"], Float[Tensor, "patch rank view"]]:
    """Return the normal equations for every view's light, including its prior."""
    packed = (weight @ quadratics.outer(shading).mT).mT.clone()
    packed[:, quadratics.diagonal(shading.shape[1])] += problem.regularization[:, None, :]
    pull = problem.regularization[..., None] * problem.prior_mean
    return packed, ((weight * problem.radiance) @ shading.mT + pull).mT


def curvature_of_views(shading: Shading, weight: Entries) -> Float[Tensor, "patch unknown unknown"]:
    """Return the Gauss-Newton matrix with fixed shading: block diagonal, one block per view."""
    batch, views, rank = len(weight), weight.shape[1], shading.shape[1]
    products = (shading[:, :, None] * shading[:, None]).flatten(1, 2)
    blocks = (weight @ products.mT).reshape(batch, views, rank, rank)
    matrix = shading.new_zeros(batch, views, rank, views, rank)
    index = torch.arange(views, device=shading.device)
    matrix[:, index, :, index] = blocks.transpose(0, 1)
    return matrix.reshape(batch, views * rank, views * rank)


def evaluate(
    problem: Bilinear, lights: Lights, shading: Shading, weight: Entries
) -> tuple[Float[Tensor, " patch"], Lights]:
    """Return the objective for given robust weights, and minus half its gradient by the lights."""
    residual = problem.radiance - lights @ shading
    weighted = weight * residual
    cost = torch.linalg.vecdot(weighted.flatten(1), residual.flatten(1))
    difference = lights - problem.prior_mean
    cost = cost + (problem.regularization * difference.square().sum(dim=2)).sum(dim=1)
    if problem.prior is not None:
        penalty = shading * quadratics.apply_packed(problem.prior, shading)
        cost = cost + penalty.sum(dim=(1, 2))
    return cost, weighted @ shading.mT - problem.regularization[..., None] * difference


def update_shading(
    problem: Bilinear, packed: Packed, rhs: Shading, shading: Shading, steps: int = 1
) -> Shading:
    r"""Return shading vectors on the manifold that minimize :math:`s^\top A s - 2 b^\top s`.

    Takes Gauss-Newton steps of bounded length along the tangents, and rejects a step that does not
    lower the objective. On a linear manifold the first step is exact.
    """
    if problem.manifold.flat:
        return quadratics.PackedCholesky(packed, shading.shape[1]).solve(rhs)
    image = quadratics.apply_packed(packed, shading)
    value = quadratics.dot(shading, image - 2 * rhs)
    for step in range(steps):
        moved = tangent_step(problem.manifold, packed, rhs - image, shading)
        moved_image = quadratics.apply_packed(packed, moved)
        after = quadratics.dot(moved, moved_image - 2 * rhs)
        # The last steps lower the objective by less than its rounding error.
        better = (after <= value + 8 * torch.finfo(value.dtype).eps * value.abs())[:, None]
        shading = torch.where(better, moved, shading)
        if step + 1 < steps:
            image = torch.where(better, moved_image, image)
            value = torch.where(better[:, 0], after, value)
    return shading


def tangent_step(manifold: Manifold, packed: Packed, slope: Shading, shading: Shading) -> Shading:
    r"""Return shading ``s`` after the step :math:`(B^\top A B)^{-1} B^\top r`, of bounded length.

    ``A`` is packed, ``B`` are the tangents, and ``slope`` is ``r = b - A s``.
    """
    columns = manifold.tangents(shading)
    descent = quadratics.coordinates(columns, slope)
    step = quadratics.PackedCholesky(curvature_in(columns, packed), len(columns)).solve(descent)
    length = quadratics.dot(step, step).detach().sqrt()[:, None]
    limit = MAX_STEP * manifold.split(shading.mT)[0].detach()[:, None]
    step = step * torch.where(length > limit, limit / length.clamp_min(1e-30), 1)
    return manifold.retract((shading + quadratics.combination(columns, step)).mT).mT


def curvature_in(columns: list[Tensor], packed: Packed) -> Float[Tensor, "patch smaller sample"]:
    """Return ``B^T A B``, packed, its diagonal raised by 1e-9 of its trace to be invertible."""
    curvature = quadratics.congruence(packed, columns)
    slot = quadratics.diagonal(len(columns))
    curvature[:, slot] += 1e-9 * curvature[:, slot].sum(dim=1, keepdim=True)
    return curvature


def keep_scale(
    problem: Bilinear, before: Lights, lights: Lights, shading: Shading
) -> tuple[Lights, Shading]:
    """Rescale unregularized lights to their previous norm, and shading inversely; return both."""
    old_square, square = before.square().sum(dim=(1, 2)), lights.square().sum(dim=(1, 2))
    free = (problem.regularization.amax(dim=1) == 0) & (square > 0) & (old_square > 0)
    factor = torch.where(free, (old_square / torch.where(square > 0, square, 1)).sqrt(), 1)
    factor = factor[:, None, None]
    return lights * factor, shading / factor


def root_mean_square(
    problem: Bilinear, lights: Lights, shading: Shading
) -> Float[Tensor, " patch"]:
    """Return each patch's weighted root mean square residual; 0 without data."""
    residual = problem.radiance - lights @ shading
    count = problem.weight.sum(dim=(1, 2))
    mean = (problem.weight * residual**2).sum(dim=(1, 2)) / torch.where(count > 0, count, 1)
    return torch.where(mean > 0, torch.where(mean > 0, mean, 1).sqrt(), 0)


def residual_deviation(problem: Bilinear, residual: Entries) -> Float[Tensor, " patch"]:
    """Return a robust standard deviation of each patch's residuals."""
    subset = residual[:, :, :: problem.stride].flatten(1)
    observed = problem.weight[:, :, :: problem.stride].flatten(1) > 0
    count = problem.weight.sum(dim=(1, 2)).clamp_min(1)
    mean_radiance = problem.radiance.abs().sum(dim=(1, 2)) / count
    return robust_deviation(subset, observed).maximum(MIN_DEVIATION * mean_radiance)


# Instead of a stop cause, for a patch that has not stopped.
RUNNING = -1


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class State(Record):
    """Iteration state shared by all solvers, batched over patches.

    Attributes:
        lights: ``L``.
        shading: ``N``, columns on the manifold.
        weight: Weight of each entry, including robust weights.
    """

    lights: Lights
    shading: Shading
    weight: Entries


AnyState = TypeVar("AnyState", bound=State)


def iterate(
    problem: Bilinear,
    state: AnyState,
    advance: Callable[[Bilinear, AnyState, int], tuple[AnyState, Int[Tensor, " patch"]]],
    max_iterations: int,
) -> Factors:
    """Iterate until every patch has stopped, and return the last state of each.

    Args:
        advance: One step of the remaining patches: maps problem, state and step index to the next
            state and, for each patch, a :class:`StopCause` or ``RUNNING``.

    Returns:
        Lights, shading, weights, number of steps and stop cause of every patch.
    """
    full = problem
    patches = torch.arange(len(problem.radiance), device=problem.radiance.device)
    iterations = torch.full_like(patches, max_iterations)
    causes = torch.full_like(patches, int(StopCause.LIMIT))
    running = torch.ones_like(patches, dtype=torch.bool)
    names = [field.name for field in dataclasses.fields(state)]
    final = state.replace(**{name: getattr(state, name).clone() for name in names})
    for step in range(max_iterations):
        state, cause = advance(problem, state, step)
        ended = running & (cause != RUNNING)
        _store(final, state, names, patches, ended)
        iterations[patches[ended]] = step + 1
        causes[patches[ended]] = cause[ended]
        running = running & ~ended
        if not bool(running.any()):
            break
        # Stopped patches are removed once they are a quarter: copying the rest takes about a step.
        if float((~running).double().mean()) >= 0.25:
            keep = running.nonzero()[:, 0]
            state, problem, patches = state.take(keep), problem.take(keep), patches[keep]
            running = running[keep]
    _store(final, state, names, patches, running)
    has_data = full.weight.sum(dim=(1, 2)) > 0
    convergence = Convergence(
        iterations=iterations,
        residual=root_mean_square(full, final.lights, final.shading),
        cause=torch.where(has_data, causes, int(StopCause.EMPTY)),
    )
    return Factors(
        lights=final.lights, shading=final.shading, weight=final.weight, convergence=convergence
    )


def _store(
    final: Record, state: Record, names: list[str], patches: Int[Tensor, " patch"], rows: Tensor
) -> None:
    for name in names:
        getattr(final, name)[patches[rows]] = getattr(state, name)[rows]
