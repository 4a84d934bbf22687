r"""Damped variable projection: shading eliminated, Gauss-Newton on the lights.

With :math:`N(L)` the optimal shading vectors for the lights, :math:`f(L) = \lVert \sqrt W (J - L
N(L)) \rVert^2` has far fewer unknowns and local minima than the joint problem. Its
Gauss-Newton matrix, in Ruhe and Wedin's second approximation, is

.. math:: H = \sum_k (n_k n_k^\top) \otimes
          (W_k - W_k L B_k (B_k^\top L^\top W_k L B_k)^{-1} B_k^\top L^\top W_k)

for samples k, with ``B`` the tangents of their manifold: all directions in low-rank
factorization, three on the photometric cone. Its null space is the ambiguity of the factorization
(an invertible matrix, or a Lorentz transformation), which damping regularizes.

Source: Ruhe & Wedin, SIAM Review 22(3), 1980; Okatani, Yoshida & Deguchi, ICCV 2011; Hong &
Fitzgibbon, ICCV 2015. Its use on the tangents of the cone is ours.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.kernels.arrays import as_array
from pimper_torch.kernels.switch import compiled_for
from pimper_torch.kernels.twin_constants import (
    DAMPING_DECREASE,
    DAMPING_INCREASE,
    INITIAL_DAMPING,
    SHADING_STEPS,
    ZERO_ROUNDINGS,
)
from pimper_torch.linalg.robust import Squares
from pimper_torch.records import Convergence, StopCause
from pimper_torch.stages.photometry import bilinear
from pimper_torch.stages.photometry.bilinear import Bilinear, Entries, Factors, Lights, Shading
from pimper_torch.stages.photometry.quadratics import PackedCholesky, congruence, outer, unpacked


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _State(bilinear.State):
    energy: Float[Tensor, " patch"]
    cost: Float[Tensor, " patch"]
    slope: Lights
    curvature: Float[Tensor, "patch unknown unknown"]
    damping: Float[Tensor, " patch"]
    small: Int[Tensor, " patch"]


def solve_variable_projection(
    problem: Bilinear,
    max_iterations: int = 300,
    tolerance: float = 1e-9,
    *,
    small_steps: int = 3,
    curvature_samples: int | None = None,
) -> Factors:
    """Return the factors of a batch of patches by damped variable projection.

    Args:
        problem: Problem with initial values. Low-rank factorization uses only the lights, which
            must have full rank.
        tolerance: A step that lowers a patch's objective by less than this fraction is small.
        small_steps: Number of consecutive small steps after which a patch has converged: longer
            steps may follow a single small one.
        curvature_samples: Approximate number of samples of a patch over which the Gauss-Newton
            matrix, most of the work, is summed; all if ``None``. This changes the steps, but not
            the minimum.

    Returns:
        A local minimum: initialize well, or restart. Low-rank lights without regularization are
        orthonormal, and others keep their initial norm.

    Not differentiable. Patches are independent. A compiled kernel solves first-order light in
    float32 (:mod:`~pimper_torch.stages.photometry.kernels.factorization`), with the same result
    up to rounding; there, samples without weight keep their initial values.
    """
    kernel = problem.has_kernel and problem.radiance.dtype == torch.float32
    if kernel and compiled_for(problem.radiance):
        return _solve_by_kernel(problem, max_iterations, tolerance, small_steps, curvature_samples)

    def advance(work: Bilinear, state: _State, step: int) -> tuple[_State, Int[Tensor, " patch"]]:
        return _step(work, state, tolerance, small_steps, curvature_samples)

    with torch.no_grad():
        state = _start(problem, curvature_samples)
        return bilinear.iterate(problem, state, advance, max_iterations)


def curvature_of_lights(
    problem: Bilinear, lights: Lights, shading: Shading, weight: Entries, samples: int | None = None
) -> Float[Tensor, "patch unknown unknown"]:
    """Return the Gauss-Newton matrices ``H``, unknowns ordered by view, with regularization.

    Args:
        samples: Approximate number of evenly spaced samples to sum over; all if ``None``.
    """
    rank = lights.shape[2]
    stride = max(1, shading.shape[2] // samples) if samples else 1
    shading, weight = shading[:, :, ::stride], weight[:, :, ::stride]
    subset = problem.replace(
        radiance=problem.radiance[:, :, ::stride],
        weight=weight,
        shading=shading,
        prior=None if problem.prior is None else problem.prior[:, :, ::stride],
    )
    per_view = bilinear.curvature_of_views(shading, weight)
    normal = per_view - _eliminated(_whitened(subset, lights, shading, weight), shading)
    regularization = problem.regularization[..., None].expand(-1, -1, rank).flatten(1)
    return stride * normal + torch.diag_embed(regularization)


def _step(
    problem: Bilinear,
    state: _State,
    tolerance: float,
    small_steps: int,
    curvature_samples: int | None,
) -> tuple[_State, Int[Tensor, " patch"]]:
    moved = state.lights + _damped_step(state)
    shading = state.shading
    if _is_free(problem):
        moved = torch.linalg.qr(moved).Q
    else:
        moved, shading = bilinear.keep_scale(problem, state.lights, moved, shading)
    equations = bilinear.equations_of_samples(problem, moved, state.weight)
    shading = bilinear.update_shading(problem, *equations, shading, SHADING_STEPS)
    after, slope = bilinear.evaluate(problem, moved, shading, state.weight)
    better = after < state.cost
    gain = (state.cost - after) / state.cost.clamp_min(torch.finfo(after.dtype).tiny)
    small = torch.where(gain < tolerance, state.small + 1, 0)
    small = torch.where(better, small, state.small)
    limit = torch.finfo(after.dtype).eps
    damping = state.damping * torch.where(better, DAMPING_DECREASE, DAMPING_INCREASE).to(after)
    exact = state.cost <= (ZERO_ROUNDINGS * limit) ** 2 * state.energy
    stalled = (damping > 1 / limit) & ~exact
    state = state.replace(small=small, damping=damping.clamp_min(limit))
    if bool(better.any()):
        keep = better[:, None, None]
        state = state.replace(
            lights=torch.where(keep, moved, state.lights),
            shading=torch.where(keep, shading, state.shading),
            cost=torch.where(better, after, state.cost),
            slope=torch.where(keep, slope, state.slope),
        )
        if not isinstance(problem.loss, Squares):
            weight = bilinear.robust_weights(problem, state.lights, state.shading)
            cost, slope = bilinear.evaluate(problem, state.lights, state.shading, weight)
            state = state.replace(weight=weight, cost=cost, slope=slope)
        point = state.lights, state.shading, state.weight
        curvature = curvature_of_lights(problem, *point, curvature_samples)
        state = state.replace(curvature=curvature)
    cause = torch.where(stalled, int(StopCause.STALLED), bilinear.RUNNING)
    return state, torch.where(exact | (small >= small_steps), int(StopCause.CONVERGED), cause)


def _start(problem: Bilinear, curvature_samples: int | None) -> _State:
    lights = torch.linalg.qr(problem.lights).Q if _is_free(problem) else problem.lights
    weight = bilinear.robust_weights(problem, lights, problem.shading)
    equations = bilinear.equations_of_samples(problem, lights, weight)
    shading = bilinear.update_shading(problem, *equations, problem.shading, SHADING_STEPS)
    cost, slope = bilinear.evaluate(problem, lights, shading, weight)
    weighted = (weight * problem.radiance).flatten(1)
    return _State(
        lights=lights,
        shading=shading,
        weight=weight,
        energy=torch.linalg.vecdot(weighted, problem.radiance.flatten(1)),
        cost=cost,
        slope=slope,
        curvature=curvature_of_lights(problem, lights, shading, weight, curvature_samples),
        damping=torch.full_like(cost, INITIAL_DAMPING),
        small=torch.zeros_like(cost).long(),
    )


def _whitened(
    problem: Bilinear, lights: Lights, shading: Shading, weight: Entries
) -> list[Entries]:
    """Return ``C_k^-1 B_k^T l_f w_fk`` by tangents; ``C C^T`` is the sample's normal matrix."""
    packed, _ = bilinear.equations_of_samples(problem, lights, weight)
    if problem.manifold.flat:
        slopes = [light[..., None] * weight for light in lights.unbind(dim=2)]
    else:
        columns = problem.manifold.tangents(shading)
        packed = congruence(packed, columns)
        slopes = [(lights @ column) * weight for column in columns]
    white = PackedCholesky(packed[:, None], len(slopes)).whiten(slopes)
    return [rows.to(lights) for rows in white]


def _eliminated(white: list[Entries], shading: Shading) -> Float[Tensor, "patch unknown unknown"]:
    """Return the sum of the samples' Schur terms ``(n n^T) (x) (white^T white)``.

    Products of views first, and then a matrix product with ``n n^T``, need several times less
    arithmetic than Kronecker products.
    """
    batch, views, samples = white[0].shape
    rank = shading.shape[1]
    pairs = outer(shading)
    blocks = shading.new_zeros(batch, views, views, pairs.shape[1])
    group = max(1, 100_000 // (views * samples))
    for view in range(0, views, group):
        chunk = slice(view, view + group)
        factors = [(rows[:, chunk, None], rows[:, None, view:]) for rows in white]
        shared = torch.mul(*factors[0])
        for factor in factors[1:]:
            shared.addcmul_(*factor)
        summed = shared.flatten(1, 2) @ pairs.mT
        blocks[:, chunk, view:] = summed.reshape(*shared.shape[:3], -1)
    upper = unpacked(blocks.flatten(1, 2).mT, rank).reshape(batch, views, views, rank, rank)
    upper = upper.transpose(2, 3).reshape(batch, views * rank, views * rank)
    view_of = torch.arange(views * rank, device=shading.device) // rank
    return torch.where(view_of[:, None] <= view_of, upper, upper.mT)


def _damped_step(state: _State) -> Lights:
    normal = state.curvature.double()
    diagonals = normal.diagonal(dim1=1, dim2=2)
    ridge = state.damping[:, None] * diagonals.mean(dim=1, keepdim=True).clamp_min(1e-300)
    damped = normal + torch.diag_embed(ridge.expand_as(diagonals))
    rhs = state.slope.double().flatten(1)[..., None]
    return torch.linalg.solve_ex(damped, rhs).result.reshape(state.slope.shape).to(state.slope)


def _is_free(problem: Bilinear) -> bool:
    """Return whether the ambiguity is any invertible matrix."""
    return problem.manifold.flat and not bool((problem.regularization > 0).any())


def _solve_by_kernel(
    problem: Bilinear,
    max_iterations: int,
    tolerance: float,
    small_steps: int,
    curvature_samples: int | None,
) -> Factors:
    from pimper_torch.stages.photometry.kernels import factorization, packed_patches

    J, code = problem.radiance, problem.loss.code
    assert code is not None  # has_kernel
    lights, shading = (
        tensor.detach().clone(memory_format=torch.contiguous_format)
        for tensor in (problem.lights, problem.shading)
    )
    weight, residual = torch.zeros_like(J), J.new_zeros(len(J))
    iterations = torch.zeros(len(J), dtype=torch.int64)
    cause = torch.zeros_like(iterations)
    data = J, problem.weight, problem.prior_mean, problem.regularization, problem.dense_prior
    results = lights, shading, weight, residual, iterations, cause
    factorization.solve_on_cone(
        packed_patches.ConeProblem(*map(as_array, data)),
        code,
        problem.loss.scale,
        problem.stride,
        factorization.Limits(max_iterations, tolerance, small_steps, curvature_samples or 0),
        packed_patches.ConeSolution(*(tensor.numpy() for tensor in results)),
    )
    convergence = Convergence(iterations=iterations, residual=residual, cause=cause)
    return Factors(lights=lights, shading=shading, weight=weight, convergence=convergence)
