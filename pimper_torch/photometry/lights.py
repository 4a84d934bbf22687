r"""The light of every view, from normals that are already known.

The coarse mesh knows the shape to a few degrees; that is enough to calibrate lights, and
lights that are calibrated leave no ambiguity for the factorization.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.photometry.harmonics import harmonics
from pimper_torch.photometry.quadratics import outer
from pimper_torch.photometry.robust import cauchy_weights, spread

# Cauchy's weights are 95 % efficient on Gaussian noise with this many standard deviations.
CAUCHY_TUNING = 2.385


def fit_lights(
    radiance: Float[Tensor, "sample view"],
    seen: Bool[Tensor, "sample view"],
    normals: Float[Tensor, "sample 3"],
    iterations: int = 40,
) -> tuple[Float[Tensor, "view 4"], Float[Tensor, " sample"]]:
    r"""Fit one light a view and one albedo a sample, robustly.

    Minimises :math:`\sum_{ig} \phi(x_{gi} - \rho_i\, l_g^\top (1, n_i))`, :math:`\phi` being
    Cauchy's loss with a scale of 2.385 spreads of the view's residuals (wider at first).
    Each step is Gauss-Newton on lights and albedo together, the albedos eliminated, damped
    until it descends; alternation would crawl along the valleys where albedo mimics light.

    Args:
        radiance: Gray, linear. Entries that are not seen do not matter.
        seen: False where missing.
        normals: Unit, in the frame the lights are wanted in.
        iterations: At most.

    Returns:
        Lights with ``(1, n)`` and albedos. The scale between them is free; here the median
        of ``|l|`` over the views is 1. A view or sample without data has zero.

    Fails where the normals span too little (a plane shows one number of each light): the
    answer is then the smallest change from lights that shine along the mean normal, and
    lights that differ are found parallel. Computed in float64. Constant to autograd.
    """
    with torch.no_grad():
        if not seen.any():
            return radiance.new_zeros(seen.shape[1], 4), radiance.new_zeros(len(seen))
        J = torch.where(seen, radiance, 0).double()
        basis = harmonics(normals).double()
        lights, albedo = _start(J, seen, basis)
        damping = 1e-3
        for step in range(iterations):
            widen = max(1.0, 4.0 * 0.7**step)
            weight, scale = _weights(J, seen, basis, lights, albedo, widen)
            cost = _cost(J, seen, basis, lights, albedo, scale)
            moved = _step(J, weight, basis, lights, albedo, damping)
            after = _cost(J, seen, basis, *moved, scale)
            if after < cost:
                lights, albedo = moved
                damping = max(damping / 4, 1e-9)
                if widen == 1 and after > cost * (1 - 1e-7):
                    break
            else:
                damping = min(damping * 10, 1e6)
        return _normalised(lights, albedo, radiance)


def _normalised(
    lights: Float[Tensor, "view 4"], albedo: Float[Tensor, " sample"], like: Float[Tensor, "..."]
) -> tuple[Float[Tensor, "view 4"], Float[Tensor, " sample"]]:
    length = lights.norm(dim=-1)
    shining = length[length > 0]
    if len(shining) == 0:
        return lights.to(like.dtype), albedo.to(like.dtype)
    factor = shining.median()
    if (albedo < 0).sum() > (albedo > 0).sum():
        factor = -factor
    return (lights / factor).to(like.dtype), (albedo * factor).to(like.dtype)


def _start(
    J: Float[Tensor, "sample view"], seen: Bool[Tensor, "sample view"], basis: Float[Tensor, "_ 4"]
) -> tuple[Float[Tensor, "view 4"], Float[Tensor, " sample"]]:
    """Take the robust brightness of views and samples for a light along the mean normal."""
    missing = torch.where(seen, J, torch.nan)
    gain = missing.nanmedian(dim=0).values.nan_to_num(nan=0.0)
    seen_gain = seen * gain
    ratio = torch.where(seen & (gain > 0), J / gain.clamp_min(1e-300), torch.nan)
    albedo = ratio.nanmedian(dim=1).values.nan_to_num(nan=0.0)
    albedo = torch.where((seen_gain > 0).any(dim=1), albedo, 0)
    mean = basis[seen.any(dim=1)].mean(dim=0)
    return gain[:, None] * mean / (mean @ mean).clamp_min(1e-12), albedo


def _weights(
    J: Float[Tensor, "sample view"],
    seen: Bool[Tensor, "sample view"],
    basis: Float[Tensor, "sample 4"],
    lights: Float[Tensor, "view 4"],
    albedo: Float[Tensor, " sample"],
    widen: float,
) -> tuple[Float[Tensor, "sample view"], Float[Tensor, " view"]]:
    residual = J - albedo[:, None] * (basis @ lights.mT)
    level = (J.sum(dim=0) / seen.sum(dim=0).clamp_min(1)).abs()
    scale = CAUCHY_TUNING * spread(residual.mT, seen.mT).maximum(1e-4 * level)
    return seen * cauchy_weights(residual, widen * scale), widen * scale


def _cost(
    J: Float[Tensor, "sample view"],
    seen: Bool[Tensor, "sample view"],
    basis: Float[Tensor, "sample 4"],
    lights: Float[Tensor, "view 4"],
    albedo: Float[Tensor, " sample"],
    scale: Float[Tensor, " view"],
) -> float:
    residual = J - albedo[:, None] * (basis @ lights.mT)
    relative = residual / torch.where(scale > 0, scale, 1)
    return float((seen * scale**2 * torch.log1p(relative**2)).sum())


def _step(
    J: Float[Tensor, "sample view"],
    weight: Float[Tensor, "sample view"],
    basis: Float[Tensor, "sample 4"],
    lights: Float[Tensor, "view 4"],
    albedo: Float[Tensor, " sample"],
    damping: float,
) -> tuple[Float[Tensor, "view 4"], Float[Tensor, " sample"]]:
    """Solve the normal equations for all lights and albedos, albedos eliminated (Schur)."""
    num_views = len(lights)
    shading = basis @ lights.mT
    residual = weight * (J - albedo[:, None] * shading)
    rows, columns = torch.triu_indices(4, 4)
    packed = (weight * albedo[:, None] ** 2).mT @ outer(basis.mT).mT
    blocks = packed.new_zeros(num_views, 4, 4)
    blocks[:, rows, columns] = packed
    blocks[:, columns, rows] = packed
    # A view without data keeps its light: a unit block, and nothing on the right.
    floor = 1e-9 * blocks.diagonal(dim1=1, dim2=2).sum(dim=1)
    floor = torch.where(floor > 0, floor, 1)
    ridge = damping * blocks.diagonal(dim1=1, dim2=2) + floor[:, None]
    damped = blocks + torch.diag_embed(ridge)
    own = (weight * shading**2).sum(dim=1) * (1 + damping)
    inverse = torch.where(own > 0, 1 / torch.where(own > 0, own, 1), 0)
    cross = ((weight * albedo[:, None] * shading)[:, :, None] * basis[:, None, :]).flatten(1)
    view = torch.arange(num_views, device=lights.device)
    spread_out = damped.new_zeros(num_views, 4, num_views, 4)
    spread_out[view, :, view, :] = damped
    schur = spread_out.reshape(4 * num_views, -1) - cross.mT @ (inverse[:, None] * cross)
    on_lights = ((albedo[:, None] * residual).mT @ basis).flatten()
    on_albedo = (residual * shading).sum(dim=1)
    rhs = on_lights - cross.mT @ (inverse * on_albedo)
    size = schur.diagonal().abs()
    step = torch.linalg.solve(schur + 1e-12 * torch.diag(size), rhs)
    return lights + step.reshape(-1, 4), albedo + inverse * (on_albedo - cross @ step)
