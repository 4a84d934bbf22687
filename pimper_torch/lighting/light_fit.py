"""Lights and albedo fitted jointly to radiance under known normals.

The solver is damped Gauss-Newton (Levenberg-Marquardt) with Cauchy's loss, and eliminates albedos
by the Schur complement. Gradients are by the implicit function theorem at the optimum.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.kernels.twin_constants import MIN_DEVIATION
from pimper_torch.lighting import light_models
from pimper_torch.lighting.light_models import ImageSamples, LightModel, Unknowns
from pimper_torch.linalg.robust import with_slope

# A fit has converged when a step lowers its cost by less than this fraction: a choice. The second
# constant is the limit of iterations and the fraction if gradients are required, from which
# Newton's method converges to rounding (`tests/photometry/test_factor_gradients.py`).
_MIN_GAIN, _TO_CONVERGENCE = 1e-7, (300, 1e-13)

# Maximum number of Newton steps, smallest fraction of a step in the line search, and relative step
# at which they end: choices; near the solution every step doubles the correct digits.
_NEWTON_STEPS, _MIN_STEP, _CONVERGED = 12, 0.05, 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class LightFit:
    """Fitted lights and albedo."""

    model: LightModel
    lights: light_models.Parameters
    albedo: light_models.Albedo

    def misfit(self, samples: ImageSamples, mask: light_models.Seen) -> Float[Tensor, " view"]:
        """Return each view's median residual in the mask over its mean radiance; NaN if empty."""
        residual = samples.radiance - self.albedo[:, None] * self.model.shade(self.lights)
        relative = residual.abs() / samples.mean_radiance.clamp_min(1e-300)
        masked = torch.where(mask, relative.clamp_min(MIN_DEVIATION), torch.nan)
        return masked.nanmedian(dim=0).values


def fit_lights(
    model: LightModel, samples: ImageSamples, iterations: int, start: Unknowns | None = None
) -> LightFit:
    """Return the fit of a model's lights and the samples' albedo. Not differentiable.

    If gradients are required, it iterates to convergence, for :func:`with_gradients`.

    Args:
        iterations: Maximum number if gradients are not required.
        start: Initial lights and albedo; by default those of :meth:`LightModel.initialize`.
    """
    from pimper_torch.lighting.kernels.lights_and_albedo import TILE, fit

    limit, min_gain = _TO_CONVERGENCE if _requires_grad(model, samples) else (iterations, _MIN_GAIN)
    with torch.no_grad():
        lights, albedo = start or model.initialize(samples)
        count, device, padding = len(albedo), albedo.device, (0, -len(albedo) % TILE)
        lights = model.clamp(lights).cpu().clone(memory_format=torch.contiguous_format)
        inputs, radiance, seen = (
            pad(each.detach().mT.to(lights), padding).contiguous().numpy()
            for each in (torch.cat(model.geometry(), dim=1), samples.radiance, samples.seen)
        )
        albedo, mean = pad(albedo.cpu(), padding), samples.mean_radiance.detach().cpu().numpy()
        closest = 1 / light_models.MIN_DISTANCE
        # A joint fit: alternation converges slowly along the valley of lights and albedo.
        fit(inputs, radiance, seen, mean, closest, limit, min_gain, lights.numpy(), albedo.numpy())
    return LightFit(model=model, lights=lights.to(device), albedo=albedo[:count].to(device))


def _requires_grad(model: LightModel, samples: ImageSamples) -> bool:
    tensors = (samples.radiance, *model.geometry())
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def with_gradients(fit: LightFit, samples: ImageSamples) -> LightFit:
    """Return the fit, differentiable in photographs and geometry if gradients are required.

    Gradients are by the implicit function theorem at the nearest stationary point: a Newton step
    from there, with constant derivatives, has length zero and the gradient. Light and albedo share
    a free factor, so the largest parameter of the lights is fixed. Parameters at a bound or without
    data are fixed as well.
    """
    if not _requires_grad(fit.model, samples):
        return fit
    model = fit.model
    with torch.no_grad():
        fixed = ~model.inside_bounds(fit.lights)
        largest = torch.where(fixed, 0, fit.lights.abs()).argmax()
        fixed = fixed.flatten().index_fill(0, largest, value=True).reshape(fixed.shape)
        lights, albedo, solve = fit.lights, fit.albedo, None
        on_lights, on_albedo = _descent(model, samples, lights, albedo)
        fraction = 1.0
        for _ in range(_NEWTON_STEPS):
            solve = solve or _newton_matrix(model, samples, lights, albedo, fixed)
            by_lights, by_albedo = solve(on_lights, on_albedo)
            trial = lights + fraction * by_lights, albedo + fraction * by_albedo
            after = _descent(model, samples, *trial)
            # Compared in units of the unknowns, as bounds and missing data leave a gradient.
            if _length(solve(*after)) < _length((by_lights, by_albedo)):
                (lights, albedo), (on_lights, on_albedo) = trial, after
                solve, fraction = None, min(1.0, 2 * fraction)
                if _length((by_lights, by_albedo)) <= _CONVERGED * _length((lights, albedo)):
                    break
            elif (fraction := fraction / 2) < _MIN_STEP:
                break
        solve = solve or _newton_matrix(model, samples, lights, albedo, fixed)
    by_lights, by_albedo = solve(*_descent(model, samples, lights, albedo))
    return LightFit(
        model=model,
        lights=lights + (by_lights - by_lights.detach()),
        albedo=albedo + (by_albedo - by_albedo.detach()),
    )


def _length(step: Unknowns) -> float:
    return math.hypot(*(float(unknowns.norm()) for unknowns in step))


def _descent(
    model: LightModel,
    samples: ImageSamples,
    lights: light_models.Parameters,
    albedo: light_models.Albedo,
) -> Unknowns:
    """Return minus half the gradient of the objective."""
    shading = model.shade(lights)
    residual = samples.residual(albedo, shading)
    weighted = samples.weights(residual, samples.scale(residual)) * residual
    by_lights = torch.einsum("sv,s,svp->vp", weighted, albedo, model.jacobian(lights))
    return by_lights, (weighted * shading).sum(dim=1)


def _newton_matrix(
    model: LightModel,
    samples: ImageSamples,
    lights: light_models.Parameters,
    albedo: light_models.Albedo,
    fixed: Bool[Tensor, "view parameter"],
) -> Callable[[Tensor, Tensor], Unknowns]:
    """Factor the exact negative derivative of :func:`_descent`; albedos are eliminated (Schur).

    The scale of a view depends on its residuals, which adds a matrix of rank one per view
    (Woodbury's formula).

    Args:
        fixed: Parameters that do not move.

    Returns:
        Function from right-hand sides of lights and albedos to the Newton step, differentiable in
        these.
    """
    num_views, size = lights.shape
    shading, jacobian = model.shade(lights), model.jacobian(lights)
    residual = samples.residual(albedo, shading)
    scale, by_residual = with_slope(samples.scale, residual)
    weight = samples.weights(residual, scale)
    weighted, bend = weight * residual, weight * (2 * weight - 1)
    slope = albedo[:, None, None] * jacobian
    blocks = (bend[..., None] * slope).permute(1, 2, 0) @ slope.transpose(0, 1)
    blocks = blocks - _second_derivatives(model, lights, weighted * albedo[:, None])
    diagonal = (bend * shading**2).sum(dim=1)
    cross = ((bend * shading)[..., None] * slope - weighted[..., None] * jacobian).flatten(1)
    # A weight depends on the residual over the scale only.
    by_scale = (weighted - bend * residual) / torch.where(scale > 0, scale, 1)
    sides = []
    for field in (by_scale, by_residual):
        on_view = torch.einsum("sv,svp->vp", field, slope)
        by_view = torch.diag_embed(on_view.mT).movedim(0, 1)
        sides.append((by_view.flatten(0, 1), field * shading))
    magnitude = (bend * shading.square()).abs().sum(dim=1)
    free = ~fixed & (blocks.diagonal(dim1=1, dim2=2).abs() > 0)
    moves, samples_move = free.flatten()[:, None], (diagonal > 1e-9 * magnitude)[:, None]
    cross = torch.where(samples_move & moves.mT, cross, 0)
    inverse = torch.where(samples_move[:, 0], 1 / torch.where(samples_move[:, 0], diagonal, 1), 0)
    dense = blocks.new_zeros(num_views, size, num_views, size)
    dense[torch.arange(num_views), :, torch.arange(num_views)] = blocks
    schur = dense.flatten(2).flatten(0, 1) - cross.mT @ (inverse[:, None] * cross)
    ridge = 1e-12 * torch.diag(schur.diagonal().abs())
    schur = torch.where(moves & moves.mT, schur + ridge, torch.eye(len(schur)).to(schur))
    factor = torch.linalg.lu_factor(schur)

    def apply(on_lights: Tensor, on_albedo: Tensor) -> tuple[Tensor, Tensor]:
        on_lights, on_albedo = torch.where(moves, on_lights, 0), inverse[:, None] * on_albedo
        step = torch.linalg.lu_solve(*factor, on_lights - cross.mT @ on_albedo)
        return step, on_albedo - inverse[:, None] * (cross @ step)

    (q_lights, q_albedo), (p_lights, p_albedo) = sides
    y_lights, y_albedo = apply(q_lights, q_albedo)
    p_lights, p_albedo = torch.where(moves, p_lights, 0), torch.where(samples_move, p_albedo, 0)
    small = torch.eye(num_views).to(schur) + p_lights.mT @ y_lights + p_albedo.mT @ y_albedo

    def solve(on_lights: Tensor, on_albedo: Tensor) -> Unknowns:
        step, others = apply(on_lights.reshape(-1, 1), on_albedo[:, None])
        factors = torch.linalg.solve(small, p_lights.mT @ step + p_albedo.mT @ others)
        step, others = step - y_lights @ factors, others - y_albedo @ factors
        return step.reshape(num_views, size), others[:, 0]

    return solve


def _second_derivatives(
    model: LightModel, lights: light_models.Parameters, weight: light_models.Entries
) -> Float[Tensor, "view parameter parameter"]:
    if model.normals is None:
        return lights.new_zeros(*lights.shape, lights.shape[1])
    with torch.enable_grad():
        point = lights.detach().requires_grad_()
        summed = torch.einsum("sv,svp->pv", weight, model.jacobian(point)).sum(dim=1)
        rows = [torch.autograd.grad(parameter, point, retain_graph=True)[0] for parameter in summed]
    return torch.stack(rows, dim=1)
