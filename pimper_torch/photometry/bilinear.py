r"""The problem both solvers solve: lights and shading vectors whose product is the data.

.. math::

    \min_{L, N} \sum_{fk} D_{fk}\, \phi(J_{fk} - l_f^\top n_k)
    + \sum_f c_f \lVert l_f - \bar l_f \rVert^2
    + \gamma \sum_k \lVert b_k - \rho_k \bar n_k \rVert^2
    \quad \text{with } n_k = (\rho_k, b_k),\ \lVert b_k \rVert = \rho_k

for every patch of a batch. :math:`\phi` is the square, or Cauchy's loss. With ``c`` and
:math:`\gamma` 0 and the square this is the published problem.
"""

import dataclasses
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.photometry.quadratics import diagonal, outer
from pimper_torch.photometry.robust import cauchy_weights, spread
from pimper_torch.records import Convergence, Record

AnyRecord = TypeVar("AnyRecord", bound=Record)

# The spread of residuals is never taken to be less than this share of a patch's brightness:
# on exact data all residuals are rounding, and none is an outlier.
SMALLEST_SPREAD = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Bilinear(Record):
    """A batch of factorization problems. Samples stand in a row, padded.

    Attributes:
        radiance: ``J``, zero where missing.
        weight: ``D``: how much each entry counts; 0 where missing.
        lights: Where the lights start.
        anchor: What the lights are pulled to.
        shading: Where ``N`` starts, columns on the cone.
        normals: What the normals are pulled to, unit.
        pull: ``c_f`` per view.
        geometry: The weight ``gamma`` of each patch.
        robust_scale: Cauchy's scale in spreads of the patch's residuals; ``None`` for
            plain least squares.
        stride: The spread is taken over every so many samples.
    """

    radiance: Float[Tensor, "patch view sample"]
    weight: Float[Tensor, "patch view sample"]
    lights: Float[Tensor, "patch view 4"]
    anchor: Float[Tensor, "patch view 4"]
    shading: Float[Tensor, "patch 4 sample"]
    normals: Float[Tensor, "patch 3 sample"]
    pull: Float[Tensor, "patch view"]
    geometry: Float[Tensor, " patch"]
    robust_scale: float | None = None
    stride: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Factors(Record):
    """The solution.

    Attributes:
        lights: ``L``.
        shading: ``N``, columns on the cone.
        weight: What each entry counted in the end: ``D`` times the robust weights.
        convergence: Of each patch.
    """

    lights: Float[Tensor, "patch view 4"]
    shading: Float[Tensor, "patch 4 sample"]
    weight: Float[Tensor, "patch view sample"]
    convergence: Convergence


def select(record: AnyRecord, patches: Int[Tensor, " chosen"]) -> AnyRecord:
    """Keep some patches of a record whose tensors all lead with the patch."""
    fields = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    chosen = {name: value[patches] for name, value in fields.items() if isinstance(value, Tensor)}
    return record.replace(**chosen)


def reweigh(
    problem: Bilinear,
    lights: Float[Tensor, "patch view 4"],
    shading: Float[Tensor, "patch 4 sample"],
) -> Float[Tensor, "patch view sample"]:
    """Give ``D`` times the weights of Cauchy's loss at the present residuals."""
    if problem.robust_scale is None:
        return problem.weight
    residual = problem.radiance - lights @ shading
    scale = problem.robust_scale * _spread(problem, residual)
    return problem.weight * cauchy_weights(residual, scale[:, None, None])


def equations_of_samples(
    problem: Bilinear,
    lights: Float[Tensor, "patch view 4"],
    weight: Float[Tensor, "patch view sample"],
) -> tuple[Float[Tensor, "patch 10 sample"], Float[Tensor, "patch 4 sample"]]:
    """Assemble the normal equations for every sample's shading vector, lights given.

    Without the geometry's pull, which :func:`geometry_of_samples` gives.
    """
    packed = outer(lights.mT) @ weight
    return packed, lights.mT @ (weight * problem.radiance)


def geometry_of_samples(problem: Bilinear) -> Float[Tensor, "patch 10 sample"]:
    r"""Give the quadratic form of :math:`\gamma \lVert b - \rho \bar n \rVert^2` in (rho, b)."""
    n = problem.normals
    gamma = problem.geometry[:, None]
    one, zero = torch.ones_like(n[:, 0]), torch.zeros_like(n[:, 0])
    square = (n * n).sum(dim=1)
    rows = [square, -n[:, 0], -n[:, 1], -n[:, 2], one, zero, zero, one, zero, one]
    return torch.stack([gamma * row for row in rows], dim=1)


def equations_of_views(
    problem: Bilinear,
    shading: Float[Tensor, "patch 4 sample"],
    weight: Float[Tensor, "patch view sample"],
) -> tuple[Float[Tensor, "patch 10 view"], Float[Tensor, "patch 4 view"]]:
    """Assemble the normal equations for every view's light, pull included."""
    packed = (weight @ outer(shading).mT).mT.clone()
    packed[:, diagonal(4)] += problem.pull[:, None, :]
    rhs = (weight * problem.radiance) @ shading.mT + problem.pull[..., None] * problem.anchor
    return packed, rhs.mT


def objective(
    problem: Bilinear,
    lights: Float[Tensor, "patch view 4"],
    shading: Float[Tensor, "patch 4 sample"],
    weight: Float[Tensor, "patch view sample"],
) -> Float[Tensor, " patch"]:
    """Evaluate what is minimised, with the robust loss frozen in ``weight``."""
    residual = problem.radiance - lights @ shading
    data = (weight * residual**2).sum(dim=(1, 2))
    coupling = (problem.pull * ((lights - problem.anchor) ** 2).sum(dim=2)).sum(dim=1)
    bent = shading[:, 1:] - shading[:, :1] * problem.normals
    return data + coupling + problem.geometry * (bent**2).sum(dim=(1, 2))


def finish(
    problem: Bilinear,
    lights: Float[Tensor, "patch view 4"],
    shading: Float[Tensor, "patch 4 sample"],
    weight: Float[Tensor, "patch view sample"],
    iterations: Int[Tensor, " patch"],
    limit: int,
) -> Factors:
    """Put the solution in its record."""
    residual = problem.radiance - lights @ shading
    count = problem.weight.sum(dim=(1, 2)).clamp_min(1)
    rms = ((problem.weight * residual**2).sum(dim=(1, 2)) / count).sqrt()
    convergence = Convergence(
        iterations=iterations, residual=rms.detach(), converged=iterations < limit
    )
    return Factors(lights=lights, shading=shading, weight=weight, convergence=convergence)


def _spread(
    problem: Bilinear, residual: Float[Tensor, "patch view sample"]
) -> Float[Tensor, " patch"]:
    some = residual[:, :, :: problem.stride].flatten(1)
    seen = problem.weight[:, :, :: problem.stride].flatten(1) > 0
    count = problem.weight.sum(dim=(1, 2)).clamp_min(1)
    level = problem.radiance.abs().sum(dim=(1, 2)) / count
    return spread(some, seen).maximum(SMALLEST_SPREAD * level)
