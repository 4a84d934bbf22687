r"""The problem all solvers solve: lights and shading vectors whose product is the data.

.. math::

    \min_{L, N} \sum_{fk} D_{fk}\, \phi(J_{fk} - l_f^\top n_k)
    + \sum_f c_f \lVert l_f - \bar l_f \rVert^2
    + \sum_k n_k^\top P_k n_k
    \quad \text{with } n_k \in \mathcal M

for every patch of a batch, with ``M`` the photometric manifold of some order of lighting and
:math:`\phi` a loss. Without ``c`` and ``P``, with squares and the cone this is the published
problem; with any vectors, low-rank factorization with missing data.

A solver is a function of such a problem, a limit of iterations and a tolerance.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.photometry.manifolds import Cone, Manifold
from pimper_torch.photometry.quadratics import (
    PackedCholesky,
    apply_packed,
    combination,
    congruence,
    coordinates,
    diagonal,
    dot,
    outer,
)
from pimper_torch.photometry.robust import Loss, Squares, spread
from pimper_torch.records import Convergence, Record, StopCause

# The spread of residuals is never taken to be less than this fraction of a patch's brightness:
# on exact data all residuals are rounding, and none is an outlier.
SMALLEST_SPREAD = 1e-4

# Robust weights follow the residuals every so many steps: they change slowly, and their
# medians cost as much as a step.
REWEIGH_EVERY = 3

# Longest step along a curved manifold, as a fraction of albedo (about radians of the normal),
# within which its quadratic model holds: a choice.
LONGEST_STEP = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Bilinear(Record):
    """A batch of factorization problems. Samples stand in a row, padded.

    Attributes:
        radiance: ``J``, zero where missing.
        weight: ``D``: how much each entry counts; 0 where missing.
        lights: Where the lights start.
        anchor: What the lights are pulled to.
        shading: Where ``N`` starts, columns on the manifold.
        regularization: ``c_f`` per view.
        prior: ``P``, packed: what else is known of the shading vectors, such as normals they
            should not bend away from (:meth:`Cone.bend
            <pimper_torch.photometry.manifolds.Cone.bend>`); ``None`` for nothing.
        manifold: What shading vectors can be.
        loss: What residuals cost, their deviation estimated patch by patch.
        stride: The deviation is taken over every so many samples.
    """

    radiance: Float[Tensor, "patch view sample"]
    weight: Float[Tensor, "patch view sample"]
    lights: Float[Tensor, "patch view rank"]
    anchor: Float[Tensor, "patch view rank"]
    shading: Float[Tensor, "patch rank sample"]
    regularization: Float[Tensor, "patch view"]
    prior: Float[Tensor, "patch packed sample"] | None = None
    manifold: Manifold = Cone()  # noqa: RUF009 - frozen
    loss: Loss = Squares()  # noqa: RUF009 - frozen
    stride: int = 1

    @property
    def requires_grad(self) -> bool:
        """Whether the solution is to carry gradients."""
        data = (self.radiance, self.anchor, self.regularization, self.prior)
        return any(part is not None and part.requires_grad for part in data)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Factors(Record):
    """The solution.

    Attributes:
        lights: ``L``.
        shading: ``N``, columns on the manifold.
        weight: What each entry counted in the end: ``D`` times the robust weights.
        convergence: Of each patch.
    """

    lights: Float[Tensor, "patch view rank"]
    shading: Float[Tensor, "patch rank sample"]
    weight: Float[Tensor, "patch view sample"]
    convergence: Convergence


Solver = Callable[[Bilinear, int, float], Factors]


def reweigh(
    problem: Bilinear,
    lights: Float[Tensor, "patch view rank"],
    shading: Float[Tensor, "patch rank sample"],
) -> Float[Tensor, "patch view sample"]:
    """Give ``D`` times the weights of the loss at the present residuals."""
    if isinstance(problem.loss, Squares):
        return problem.weight
    residual = problem.radiance - lights @ shading
    deviation = deviation_of(problem, residual)
    return problem.weight * problem.loss.weights(residual, deviation[:, None, None])


def equations_of_samples(
    problem: Bilinear,
    lights: Float[Tensor, "patch view rank"],
    weight: Float[Tensor, "patch view sample"],
) -> tuple[Float[Tensor, "patch packed sample"], Float[Tensor, "patch rank sample"]]:
    """Assemble the normal equations for every sample's shading vector, lights given."""
    packed = outer(lights.mT) @ weight
    if problem.prior is not None:
        packed = packed + problem.prior
    return packed, lights.mT @ (weight * problem.radiance)


def equations_of_views(
    problem: Bilinear,
    shading: Float[Tensor, "patch rank sample"],
    weight: Float[Tensor, "patch view sample"],
) -> tuple[Float[Tensor, "patch packed view"], Float[Tensor, "patch rank view"]]:
    """Assemble the normal equations for every view's light, pull included."""
    packed = (weight @ outer(shading).mT).mT.clone()
    packed[:, diagonal(shading.shape[1])] += problem.regularization[:, None, :]
    rhs = (weight * problem.radiance) @ shading.mT + problem.regularization[
        ..., None
    ] * problem.anchor
    return packed, rhs.mT


def curvature_of_views(
    shading: Float[Tensor, "patch rank sample"], weight: Float[Tensor, "patch view sample"]
) -> Float[Tensor, "patch unknown unknown"]:
    """Give the block diagonal of the Gauss-Newton matrix: one block per view, shading fixed."""
    batch, views, rank = len(weight), weight.shape[1], shading.shape[1]
    products = (shading[:, :, None] * shading[:, None]).flatten(1, 2)
    blocks = (weight @ products.mT).reshape(batch, views, rank, rank)
    whole = shading.new_zeros(batch, views, rank, views, rank)
    index = torch.arange(views, device=shading.device)
    whole[:, index, :, index] = blocks.transpose(0, 1)
    return whole.reshape(batch, views * rank, views * rank)


def objective(
    problem: Bilinear,
    lights: Float[Tensor, "patch view rank"],
    shading: Float[Tensor, "patch rank sample"],
    weight: Float[Tensor, "patch view sample"],
) -> Float[Tensor, " patch"]:
    """Evaluate what is minimised, with the robust loss frozen in ``weight``."""
    return evaluate(problem, lights, shading, weight)[0]


def evaluate(
    problem: Bilinear,
    lights: Float[Tensor, "patch view rank"],
    shading: Float[Tensor, "patch rank sample"],
    weight: Float[Tensor, "patch view sample"],
) -> tuple[Float[Tensor, " patch"], Float[Tensor, "patch view rank"]]:
    """Give the :func:`objective`, and minus half its gradient by the lights."""
    residual = problem.radiance - lights @ shading
    heavy = weight * residual
    cost = torch.linalg.vecdot(heavy.flatten(1), residual.flatten(1))
    difference = lights - problem.anchor
    cost = cost + (problem.regularization * difference.square().sum(dim=2)).sum(dim=1)
    if problem.prior is not None:
        bent = shading * apply_packed(problem.prior, shading)
        cost = cost + bent.sum(dim=(1, 2))
    return cost, heavy @ shading.mT - problem.regularization[..., None] * difference


def follow(
    problem: Bilinear,
    packed: Float[Tensor, "patch packed sample"],
    rhs: Float[Tensor, "patch rank sample"],
    shading: Float[Tensor, "patch rank sample"],
    steps: int = 1,
) -> Float[Tensor, "patch rank sample"]:
    r"""Bring every sample to the minimum of :math:`s^\top A s - 2 b^\top s` on the manifold.

    By Gauss-Newton steps along the manifold, at most as long as their model holds; a sample that
    a step does not help stays. Exact at once where any vector will do.
    """
    if problem.manifold.flat:
        return PackedCholesky(packed, shading.shape[1]).solve(rhs)
    image = apply_packed(packed, shading)
    value = dot(shading, image - 2 * rhs)
    for step in range(steps):
        moved = step_along(problem.manifold, packed, rhs - image, shading)
        reached = apply_packed(packed, moved)
        after = dot(moved, reached - 2 * rhs)
        # The last steps are too small for the value to show.
        better = (after <= value + 8 * torch.finfo(value.dtype).eps * value.abs())[:, None]
        shading = torch.where(better, moved, shading)
        if step + 1 < steps:
            image = torch.where(better, reached, image)
            value = torch.where(better[:, 0], after, value)
    return shading


def step_along(
    manifold: Manifold,
    packed: Float[Tensor, "patch packed sample"],
    slope: Float[Tensor, "patch rank sample"],
    shading: Float[Tensor, "patch rank sample"],
) -> Float[Tensor, "patch rank sample"]:
    r"""Take the step :math:`(B^\top A B)^{-1} B^\top r`, ``B`` the manifold's tangents.

    Args:
        manifold: Along which to go.
        packed: ``A``.
        slope: ``r = b - A s``.
        shading: ``s``.
    """
    columns = manifold.tangents(shading)
    descent = coordinates(columns, slope)
    step = PackedCholesky(curvature_along(columns, packed), len(columns)).solve(descent)
    length = dot(step, step).detach().sqrt()[:, None]
    limit = LONGEST_STEP * manifold.split(shading.mT)[0].detach()[:, None]
    step = step * torch.where(length > limit, limit / length.clamp_min(1e-30), 1)
    return manifold.retract((shading + combination(columns, step)).mT).mT


def curvature_along(
    columns: list[Tensor], packed: Float[Tensor, "patch packed sample"]
) -> Float[Tensor, "patch smaller sample"]:
    """Give ``B^T A B``, packed, raised a little so that it can be inverted."""
    curvature = congruence(packed, columns)
    slot = diagonal(len(columns))
    curvature[:, slot] += 1e-9 * curvature[:, slot].sum(dim=1, keepdim=True)
    return curvature


def keep_scale(
    problem: Bilinear,
    before: Float[Tensor, "patch view rank"],
    lights: Float[Tensor, "patch view rank"],
    shading: Float[Tensor, "patch rank sample"],
) -> tuple[Float[Tensor, "patch view rank"], Float[Tensor, "patch rank sample"]]:
    """Normalize lights without regularization to their former size; rescale shading inversely."""
    was, size = before.square().sum(dim=(1, 2)), lights.square().sum(dim=(1, 2))
    loose = (problem.regularization.amax(dim=1) == 0) & (size > 0) & (was > 0)
    factor = torch.where(loose, (was / torch.where(size > 0, size, 1)).sqrt(), 1)[:, None, None]
    return lights * factor, shading / factor


def finish(
    problem: Bilinear,
    lights: Float[Tensor, "patch view rank"],
    shading: Float[Tensor, "patch rank sample"],
    weight: Float[Tensor, "patch view sample"],
    iterations: Int[Tensor, " patch"],
    cause: Int[Tensor, " patch"],
) -> Factors:
    """Put the solution in its record."""
    some = problem.weight.sum(dim=(1, 2)) > 0
    empty = torch.full_like(cause, int(StopCause.EMPTY))
    convergence = Convergence(
        iterations=iterations,
        residual=root_mean_square(problem, lights, shading),
        cause=torch.where(some, cause, empty),
    )
    return Factors(lights=lights, shading=shading, weight=weight, convergence=convergence)


def root_mean_square(
    problem: Bilinear,
    lights: Float[Tensor, "patch view rank"],
    shading: Float[Tensor, "patch rank sample"],
) -> Float[Tensor, " patch"]:
    """Give the root mean square residual over what was observed; 0 where nothing was."""
    residual = problem.radiance - lights @ shading
    count = problem.weight.sum(dim=(1, 2))
    mean = (problem.weight * residual**2).sum(dim=(1, 2)) / torch.where(count > 0, count, 1)
    return torch.where(mean > 0, torch.where(mean > 0, mean, 1).sqrt(), 0)


def deviation_of(
    problem: Bilinear, residual: Float[Tensor, "patch view sample"]
) -> Float[Tensor, " patch"]:
    """Estimate the standard deviation of each patch's residuals, robustly."""
    some = residual[:, :, :: problem.stride].flatten(1)
    seen = problem.weight[:, :, :: problem.stride].flatten(1) > 0
    count = problem.weight.sum(dim=(1, 2)).clamp_min(1)
    level = problem.radiance.abs().sum(dim=(1, 2)) / count
    return spread(some, seen).maximum(SMALLEST_SPREAD * level)
