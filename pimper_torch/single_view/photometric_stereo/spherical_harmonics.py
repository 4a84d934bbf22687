r"""Photometric stereo under general, unknown lighting, by four spherical harmonics.

A convex Lambertian surface under distant light reflects, to first order,
:math:`\rho\, l^\top (1, n)`. These shading vectors lie on a cone, so that a factorization is
unique up to a scaled Lorentz transformation even without integrability.

Source: Basri, Jacobs & Kemelmacher, Photometric stereo with general, unknown lighting, IJCV
72(3), 2007.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.photometry.cone import project_to_cone
from pimper_torch.records import Record
from pimper_torch.single_view.factorization.ambiguity import Ambiguity, lorentz
from pimper_torch.single_view.factorization.spectral import upgrade_to_cone
from pimper_torch.single_view.photometric_stereo.factorization import factorize_photographs
from pimper_torch.single_view.photometric_stereo.integrability import (
    Curls,
    both_ways,
    curls,
    moments,
    reweighted,
    wedge,
)
from pimper_torch.single_view.photometric_stereo.relief import bulge

# Random Lorentz transformations from which the search for the integrable one starts, and the
# rapidity of their boosts from the rest frame of the mean shading vector: choices.
_STARTS, _RAPIDITY = 48, 1.0
# Scale of the penalty on boosts: an unbounded boost makes all normals equal, which is integrable.
# The mean normal of a visible half ball has a Lorentz factor of 1.3, of normals within 20 degrees
# 6.
_LORENTZ_FACTOR = 6.0
_STEPS, _ITERATIONS = 40, 5
_NUDGE = 1e-6  # of forward differences in float64


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Harmonic(Record):
    """Shading and lights of a factorization by harmonics.

    Attributes:
        shading: ``rho (1, n)`` of the pixels inside the mask, raster order, on the cone.
        lights: Of four harmonics.
        weight: Final weight of each sample.
        ambiguity: The Lorentz transformation found by integrability, after the cone.
        curl: Relative residual of integrability; 0 for a surface.
    """

    shading: Float[Tensor, "4 pixel"]
    lights: Float[Tensor, "view 4"]
    weight: Float[Tensor, "view pixel"]
    ambiguity: Ambiguity
    curl: float


def four_harmonic_stereo(
    radiance: Float[Tensor, "view pixel"],
    weight: Float[Tensor, "view pixel"],
    mask: Bool[Tensor, "height width"],
    generator: torch.Generator,
    *,
    robust: bool = False,
) -> Harmonic:
    """Recover shading and lights from photographs under first-order light; convex.

    Rank-four factorization, the quadric through the shading vectors for the cone, and the Lorentz
    transformation under which normals are integrable: the remaining ambiguity is convex or
    concave, and one factor between albedo and light.

    The paper solves integrability for the rows of the matrix linearly and projects them; here
    the same equations are minimized within the Lorentz group from many starts, which keeps
    the cone.

    Args:
        radiance: Linear, gray, of the pixels inside the mask in raster order.
        weight: Not negative; 0 where missing.
        generator: Of the starts; on the CPU.
        robust: Whether what harmonics do not explain loses weight: highlights, but also what
            point lights leave in attached shadow, so leave it for soft light.

    Raises:
        InputError: Fewer than four views, or too few pixels for integrability.

    Fails with cast shadows, which are not functions of the normal; where all lights come
    from a narrow cone, as point lights without shadows are of rank three and do not determine
    the quadric; and for a surface of revolution seen along its axis, where boosts along the axis
    are integrable, too. Constant to autograd.
    """
    with torch.no_grad():
        found = factorize_photographs(radiance, weight, 4, robust=robust, shadows="none")
        reliability = found.weight.sum(dim=0)
        reliability = reliability / reliability.amax()
        L, S = upgrade_to_cone(found.lights, found.shading, reliability)
        applied, curl = _resolved(S, reliability, mask, torch.linalg.inv(L.mT @ L), generator)
        on_cone = project_to_cone(applied.on_shading(S).mT).mT
        return Harmonic(
            shading=on_cone,
            lights=applied.on_lights(L),
            weight=found.weight,
            ambiguity=applied,
            curl=curl,
        )


def _resolved(
    cone: Float[Tensor, "4 pixel"],
    weight: Float[Tensor, " pixel"],
    mask: Bool[Tensor, "height width"],
    noise: Float[Tensor, "4 4"],
    generator: torch.Generator,
) -> tuple[Ambiguity, float]:
    """Find the Lorentz transformation after which normals are those of a convex surface."""
    mean = (weight * cone).sum(dim=1)
    matrix, curl = _surface(curls(cone, weight, mask, noise), mean, generator)
    signs = torch.ones(4).to(matrix)
    # Integrability does not determine the sign of n_z, nor the common one of n_x and n_y.
    signs[3] = torch.where((weight * (matrix @ cone)[3].sign()).sum() > 0, -1.0, 1.0)
    signs[1:3] = bulge((matrix @ cone)[1:3], weight, mask)
    return Ambiguity(matrix=signs[:, None] * matrix), curl


def _surface(
    equations: Curls, mean: Float[Tensor, " 4"], generator: torch.Generator
) -> tuple[Float[Tensor, "4 4"], float]:
    """Find the Lorentz transformation whose space rows are integrable; Gauss-Newton, batched."""
    drawn = torch.randn(_STARTS, 6, generator=generator, dtype=torch.float64)
    drawn[:, :3] *= _RAPIDITY
    drawn[:, 3:] *= 2.0  # rotations of any angle
    drawn[0] = 0
    boosted = lorentz(drawn).to(mean) @ _rest_frame_boost(mean)
    matrix = torch.cat([torch.eye(4).to(mean)[None], boosted])
    reweighted_equations = equations
    metric = both_ways(equations.noise)
    for iteration in range(_ITERATIONS):
        full, terms = moments(reweighted_equations)
        values, vectors = torch.linalg.eigh(full)
        root = values.clamp_min(0).sqrt()[:, None] * vectors.mT
        matrix, cost = _descend(matrix, root, metric, mean)
        best = int(cost.argmin())
        solution = _bivectors(matrix[best])
        reweighted_equations = equations.replace(weight=reweighted(equations, solution))
        if iteration == 0:
            matrix = matrix[cost.argsort()[:4]]
            best = 0
    fraction = (solution @ full @ solution) / (solution @ terms @ solution)
    return matrix[best], float(fraction.clamp_min(0).sqrt())


def _rest_frame_boost(vector: Float[Tensor, " 4"]) -> Float[Tensor, "4 4"]:
    """Return the boost to a vector's rest frame; the identity for vectors outside the cone."""
    length = vector[1:].norm()
    if not bool((length > 0) & (length < vector[0])):
        return torch.eye(4).to(vector)
    rapidity = torch.atanh(length / vector[0])
    zero = torch.zeros_like(vector[1:])
    return lorentz(torch.cat([-rapidity * vector[1:] / length, zero]))


def _descend(
    matrix: Float[Tensor, "start 4 4"],
    root: Float[Tensor, "row both"],
    metric: Float[Tensor, "both both"],
    mean: Float[Tensor, " 4"],
) -> tuple[Float[Tensor, "start 4 4"], Float[Tensor, " start"]]:
    nudges = lorentz(_NUDGE * torch.eye(6).to(matrix))
    eye = torch.eye(6).to(matrix)
    damping = torch.full_like(matrix[:, 0, 0], 1e-2)
    residual = _residual(matrix, root, metric, mean)
    cost = residual.square().sum(dim=-1)
    for _ in range(_STEPS):
        nudged = _residual(nudges @ matrix[:, None], root, metric, mean)
        J = (nudged - residual[:, None]) / _NUDGE  # start, generator, row
        normal = J @ J.mT
        ridge = damping * normal.diagonal(dim1=1, dim2=2).mean(dim=1) + 1e-300
        rhs = -(J @ residual[..., None])
        step = torch.linalg.solve(normal + ridge[:, None, None] * eye, rhs)[..., 0]
        step = step * (1 / step.norm(dim=1, keepdim=True).clamp_min(1e-30)).clamp_max(1)
        moved = lorentz(step) @ matrix
        after = _residual(moved, root, metric, mean)
        better = after.square().sum(dim=-1) < cost
        matrix = torch.where(better[:, None, None], moved, matrix)
        residual = torch.where(better[:, None], after, residual)
        cost = residual.square().sum(dim=-1)
        damping = (damping * torch.where(better, 0.2, 5.0)).clamp(1e-12, 1e12)
    return matrix, cost


def _residual(
    matrix: Float[Tensor, "*batch 4 4"],
    root: Float[Tensor, "row both"],
    metric: Float[Tensor, "both both"],
    mean: Float[Tensor, " 4"],
) -> Float[Tensor, "*batch row"]:
    """Return the equations' residuals in units of noise, with a penalty on boosts."""
    both = _bivectors(matrix)
    noise = ((both @ metric) * both).sum(dim=-1, keepdim=True)
    moved = matrix @ mean
    time, space = moved[..., :1], moved[..., 1:]
    mass = (time.square() - space.square().sum(dim=-1, keepdim=True)).abs().clamp_min(1e-300)
    factor = time.square() / mass
    return (both @ root.mT) / noise.sqrt() * (1 + factor / _LORENTZ_FACTOR**2).sqrt()


def _bivectors(matrix: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch both"]:
    first, second, third = matrix[..., 1, :], matrix[..., 2, :], matrix[..., 3, :]
    return torch.cat([wedge(second, third), wedge(third, first)], dim=-1)
