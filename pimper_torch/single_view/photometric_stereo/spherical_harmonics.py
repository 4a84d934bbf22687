r"""Photometric stereo under general, unknown lighting, by four or nine spherical harmonics.

A convex Lambertian surface under distant light reflects, to first order,
:math:`\rho\, l^\top (1, n)`, and to second order nine harmonics of the normal. Shading vectors of
four dimensions lie on a cone, so that a factorization is unique up to a scaled Lorentz
transformation even without integrability.

Source: Basri, Jacobs & Kemelmacher, Photometric stereo with general, unknown lighting, IJCV
72(3), 2007.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.photometry.cone import project_to_cone, split_shading
from pimper_torch.records import Record
from pimper_torch.single_view.factorization.ambiguity import Ambiguity, lorentz
from pimper_torch.single_view.factorization.manifolds import second_order
from pimper_torch.single_view.factorization.spectral import upgrade_to_cone
from pimper_torch.single_view.photometric_stereo.factorization import evenly, factorize_photographs
from pimper_torch.single_view.photometric_stereo.integrability import (
    Curls,
    both_ways,
    curls,
    moments,
    reweighted,
    wedge,
)
from pimper_torch.single_view.photometric_stereo.regression import regress
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
_MIN_GAIN = 1e-6  # relative decrease of the residual at convergence
_MAX_PIXELS = 1000  # for the map from nine dimensions to normals, which has 27 numbers


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Harmonic(Record):
    """Shading and lights of a factorization by harmonics.

    Attributes:
        shading: ``rho (1, n)`` of the pixels inside the mask, raster order, on the cone.
        lights: Of four or nine harmonics; see :func:`nine_harmonics`.
        weight: Final weight of each sample.
        ambiguity: The Lorentz transformation found by integrability, after the cone.
        curl: Relative residual of integrability; 0 for a surface.
    """

    shading: Float[Tensor, "4 pixel"]
    lights: Float[Tensor, "view harmonic"]
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


def nine_harmonic_stereo(
    radiance: Float[Tensor, "view pixel"],
    weight: Float[Tensor, "view pixel"],
    mask: Bool[Tensor, "height width"],
    generator: torch.Generator,
    *,
    robust: bool = False,
) -> Harmonic:
    r"""Refine the first-order solution by light of second order; convex.

    In the nine dimensions of a factorization the normals are a linear map of it, 3 x 9. The map
    is regressed on the first-order solution and refined until the nine harmonics of its normals
    best fit the factorization. The ambiguity is again Lorentz: the nine harmonics are the
    quadratic forms of :math:`k = (1, n)` on the cone, so :math:`n \to n'` with
    :math:`\Lambda k = t (1, n')` and :math:`\rho \to t^2 \rho` preserves their span.
    Integrability resolves it as for four. The paper does not say how the map is found; here it
    is by Gauss-Newton on the residual, the mixing matrix of 9 x 9 eliminated. That the ambiguity
    is Lorentz is our observation, checked by a test.

    Args:
        radiance: As in :func:`four_harmonic_stereo`.

    Returns:
        ``lights`` have nine columns, in the order of :func:`nine_harmonics`.

    Raises:
        InputError: Fewer than nine views, or too few pixels.
    """
    with torch.no_grad():
        found = factorize_photographs(radiance, weight, 9, robust=robust, shadows="none")
        start = four_harmonic_stereo(radiance, weight, mask, generator, robust=robust)
        reliability = found.weight.sum(dim=0)
        reliability = reliability / reliability.amax()
        S = found.shading
        some = evenly(S.shape[1], _MAX_PIXELS).to(S.device)
        linear = _regressed(S, start.shading[1:], reliability)
        linear = _explain(linear, S[:, some], reliability[some])
        vector = linear @ S
        length = vector.norm(dim=0)
        cone = torch.cat([length[None], vector])
        noise = torch.zeros(4, 4).to(linear)
        noise[1:, 1:] = linear @ linear.mT
        noise[0, 0] = noise.trace() / 3
        applied, curl = _resolved(cone, reliability, mask, noise, generator)
        moved = applied.on_shading(cone)
        normal = split_shading(project_to_cone(moved.mT))[1].mT
        # From rho (1, n) to t rho (1, n'), and then to t^2 rho.
        albedo = moved[0] ** 2 / torch.where(length > 0, length, 1)
        basis = albedo * second_order(normal.mT).mT
        lights = regress(
            torch.where(weight > 0, radiance, 0).double().mT,
            weight.double().mT,
            basis.mT,
            robust=robust,
            shadows="none",
        )
        return start.replace(
            shading=albedo * torch.cat([torch.ones_like(albedo[None]), normal]),
            lights=lights.shading.mT,
            weight=lights.weight.mT,
            ambiguity=applied,
            curl=curl,
        )


def _explain(
    linear: Float[Tensor, "3 9"], S: Float[Tensor, "9 pixel"], weight: Float[Tensor, " pixel"]
) -> Float[Tensor, "3 9"]:
    """Refine the map to normals until their harmonics best fit the factorization."""
    root = weight.sqrt()

    def misfit(flat: Float[Tensor, " entry"]) -> Float[Tensor, " residual"]:
        vector = flat.reshape(3, 9) @ S
        albedo = vector.norm(dim=0)
        normal = vector / torch.where(albedo > 0, albedo, 1)
        basis = root * albedo * second_order(normal.mT).mT
        # An orthonormal basis of the rows: the part of S outside their span is the residual.
        rows = torch.linalg.qr(basis.mT).Q
        heavy = root * S
        return (heavy - (heavy @ rows) @ rows.mT).flatten()

    at = (linear / linear.norm()).flatten()
    residual = misfit(at)
    damping = 1e-3
    for _ in range(_STEPS):
        nudges = _NUDGE * torch.eye(len(at)).to(at)
        J = torch.stack([(misfit(at + nudge) - residual) / _NUDGE for nudge in nudges])
        normal = J @ J.mT
        ridge = damping * normal.diagonal().mean() * torch.eye(len(at)).to(at)
        moved = at - torch.linalg.solve(normal + ridge, J @ residual)
        after = misfit(moved)
        if after.square().sum() < residual.square().sum():
            gain = 1 - float(after.square().sum() / residual.square().sum())
            at, residual, damping = moved, after, max(damping * 0.2, 1e-12)
            if gain < _MIN_GAIN:
                break
        else:
            damping = min(damping * 5.0, 1e12)
    return at.reshape(3, 9) * linear.norm()


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


def _regressed(
    source: Float[Tensor, "in pixel"],
    target: Float[Tensor, "out pixel"],
    weight: Float[Tensor, " pixel"],
) -> Float[Tensor, "out in"]:
    moment = (weight * source) @ source.mT
    ridge = 1e-12 * moment.diagonal().mean() * torch.eye(len(moment)).to(moment)
    return torch.linalg.solve(moment + ridge, (weight * source) @ target.mT).mT
