"""Lights and albedo fitted jointly to radiance under known normals.

By damped Gauss-Newton (Levenberg-Marquardt) on both, albedos eliminated by the Schur complement,
with Cauchy's loss; gradients by the implicit function theorem at the optimum.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.kernels.twin_constants import MIN_DEVIATION
from pimper_torch.linalg.implicit import implicit_solution, newton_solution
from pimper_torch.photometry.light_models import MIN_DISTANCE, ImageSamples, LightModel

# A fit has converged when a step lowers its cost by less than this fraction: a choice. The second
# is the limit of iterations and the fraction where gradients are required, from which Newton's
# method converges to rounding (`tests/photometry/test_factor_gradients.py`).
_MIN_GAIN, _TO_CONVERGENCE = 1e-7, (300, 1e-13)


@dataclass(frozen=True, slots=True, kw_only=True)
class LightFit:
    """Fitted lights and albedo."""

    model: LightModel
    lights: Float[Tensor, "view parameter"]
    albedo: Float[Tensor, " sample"]

    def misfit(
        self, samples: ImageSamples, some: Bool[Tensor, "sample view"]
    ) -> Float[Tensor, " view"]:
        """Return the median residual of some samples, in brightnesses of their views.

        NaN in views that have none of them.
        """
        residual = samples.radiance - self.albedo[:, None] * self.model.shade(self.lights)
        relative = residual.abs() / samples.level.clamp_min(1e-300)
        missing = torch.where(some, relative.clamp_min(MIN_DEVIATION), torch.nan)
        return missing.nanmedian(dim=0).values


def fit_lights(
    model: LightModel,
    samples: ImageSamples,
    iterations: int,
    start: tuple[Float[Tensor, "view parameter"], Float[Tensor, " sample"]] | None = None,
) -> LightFit:
    """Fit a model's lights and the samples' albedo; a constant to autograd.

    Where gradients are required, it iterates to convergence: see :func:`with_gradients`.

    Args:
        iterations: At most, where no gradients are required.
        start: Lights and albedo; by default, see :meth:`LightModel.initialize`.
    """
    limit, min_gain = _TO_CONVERGENCE if _requires_grad(model, samples) else (iterations, _MIN_GAIN)
    with torch.no_grad():
        lights, albedo = start or model.initialize(samples)
        lights, albedo = _minimize(model, samples, model.clamp(lights), albedo, limit, min_gain)
    return LightFit(model=model, lights=lights, albedo=albedo)


def _requires_grad(model: LightModel, samples: ImageSamples) -> bool:
    parts = (samples.radiance, *model.geometry())
    return torch.is_grad_enabled() and any(part.requires_grad for part in parts)


def _minimize(
    model: LightModel,
    samples: ImageSamples,
    lights: Float[Tensor, "view parameter"],
    albedo: Float[Tensor, " sample"],
    limit: int,
    min_gain: float,
) -> tuple[Float[Tensor, "view parameter"], Float[Tensor, " sample"]]:
    """Minimize over lights and albedo jointly; alternation converges slowly along their valley."""
    from pimper_torch.kernels.lights_and_albedo import TILE, fit

    count, device = len(albedo), albedo.device
    lights, found = lights.cpu().clone(memory_format=torch.contiguous_format), albedo.cpu()
    padding = (0, -count % TILE)
    known, radiance, seen = (
        pad(each.detach().mT.to(found), padding).contiguous().numpy()
        for each in (torch.cat(model.geometry(), dim=1), samples.radiance, samples.seen)
    )
    found, level = pad(found, padding), samples.level.detach().cpu()
    fit(
        known,
        radiance,
        seen,
        level.numpy(),
        1 / MIN_DISTANCE,
        limit,
        min_gain,
        lights.numpy(),
        found.numpy(),
    )
    return lights.to(device), found[:count].to(device)


def with_gradients(found: LightFit, samples: ImageSamples) -> LightFit:
    """Make the fit differentiable in photographs and geometry, if gradients are required.

    By the implicit function theorem, at the nearest stationary point. Light and albedo share a
    free factor: the largest parameter of the lights is fixed, and so are parameters at a bound
    or without data.
    """
    if not _requires_grad(found.model, samples):
        return found
    model, count = found.model, found.lights.numel()
    start = torch.cat([found.lights.flatten(), found.albedo])

    def gradient(at: Float[Tensor, " unknown"]) -> Float[Tensor, " unknown"]:
        lights, albedo = at[:count].reshape(found.lights.shape), at[count:]
        shading = model.shade(lights)
        residual = samples.residual(albedo, shading)
        weighted = samples.weights(residual, samples.scale(residual)) * residual
        by_lights = torch.einsum("sv,s,svp->vp", weighted, albedo, model.jacobian(lights))
        return torch.cat([by_lights.flatten(), (weighted * shading).sum(dim=1)])

    with torch.no_grad():
        shading = model.shade(found.lights)
        residual = samples.residual(found.albedo, shading)
        weight = samples.weights(residual, samples.scale(residual))
        by_lights = found.albedo[:, None, None] * model.jacobian(found.lights)
        solve = _gauss_newton(shading, by_lights, weight)
        observed = (weight * shading**2).sum(dim=1) > 0
        fixed = ~torch.cat([model.inside_bounds(found.lights).flatten(), observed])
        flat = found.lights.abs().flatten()
        fixed[torch.where(fixed[:count], 0, flat).argmax()] = True

    def equations(at: Float[Tensor, " unknown"]) -> Float[Tensor, " unknown"]:
        return torch.where(fixed, start - at, gradient(at))

    def precondition(side: Float[Tensor, " unknown"]) -> Float[Tensor, " unknown"]:
        inner = torch.where(fixed, 0, side)
        lights, albedo = solve(inner[:count].reshape(found.lights.shape), inner[count:])
        return -torch.where(fixed, side, torch.cat([lights.flatten(), albedo]))

    solution = newton_solution(equations, start, precondition)
    answer = implicit_solution(equations, solution, precondition)
    return LightFit(
        model=model,
        lights=answer[:count].reshape(found.lights.shape),
        albedo=answer[count:],
    )


def _gauss_newton(
    shading: Float[Tensor, "sample view"],
    jacobian: Float[Tensor, "sample view parameter"],
    weight: Float[Tensor, "sample view"],
) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Factor Gauss-Newton's equations of lights and albedos, these eliminated (Schur).

    Args:
        shading: Radiance of albedo 1, which is the derivative by the albedos.
        jacobian: The derivatives by the parameters of the lights.

    Returns:
        The solution by right-hand sides of lights and albedos.
    """
    damping = 1e-6  # the free factor of light and albedo makes them singular
    _, num_views, size = jacobian.shape
    heavy = weight[..., None] * jacobian
    blocks = heavy.permute(1, 2, 0) @ jacobian.transpose(0, 1)
    diagonal = blocks.diagonal(dim1=1, dim2=2)
    # A view without data keeps its light: a unit block and a zero right-hand side. So does a
    # parameter without data.
    floor = 1e-9 * diagonal.sum(dim=1, keepdim=True)
    floor = torch.where(floor > 0, floor, 1)
    damped = blocks + torch.diag_embed(damping * diagonal + floor)
    own_block = (weight * shading**2).sum(dim=1) * (1 + damping)
    inverse = torch.where(own_block > 0, 1 / torch.where(own_block > 0, own_block, 1), 0)
    cross = (heavy * shading[..., None]).flatten(1)
    view = torch.arange(num_views, device=jacobian.device)
    blocks_of_views = damped.new_zeros(num_views, size, num_views, size)
    blocks_of_views[view, :, view, :] = damped
    schur = blocks_of_views.reshape(size * num_views, -1) - cross.mT @ (inverse[:, None] * cross)
    ridge = 1e-12 * torch.diag(schur.diagonal().abs())
    factor = torch.linalg.lu_factor(schur + ridge)

    def solve(
        on_lights: Float[Tensor, "view parameter"], on_albedo: Float[Tensor, " sample"]
    ) -> tuple[Float[Tensor, "view parameter"], Float[Tensor, " sample"]]:
        rhs = on_lights.flatten() - cross.mT @ (inverse * on_albedo)
        step = torch.linalg.lu_solve(*factor, rhs[:, None])[:, 0]
        return step.reshape(on_lights.shape), inverse * (on_albedo - cross @ step)

    return solve
