"""Lights and albedo fitted together to radiance under known normals.

Damped Gauss-Newton steps on both, the albedos eliminated, under Cauchy's loss; gradients by the
implicit function at the optimum.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.kernels.switch import compiled_for
from pimper_torch.linalg.implicit import implicit_solution, newton_solution
from pimper_torch.photometry.light_models import MIN_DISTANCE, LightModel
from pimper_torch.photometry.shown import Shown

# A fit has converged when a step lowers its cost by less than this fraction; and the iterations
# and fraction where gradients are required, from which Newton's method continues.
_MIN_GAIN, _AT_REST = 1e-7, (300, 1e-13)

# Fraction of the diagonal added to the normal equations as a preconditioner, a choice: the free
# factor of light and albedo makes them singular.
_PRECONDITIONER_DAMPING = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class LightFit:
    """A fit, and its median residual as a fraction of the view's brightness."""

    model: LightModel
    lights: Float[Tensor, "view parameter"]
    albedo: Float[Tensor, " sample"]
    misfit: float


def fit_lights(model: LightModel, shown: Shown, iterations: int) -> LightFit:
    """Fit a model's lights and the samples' albedo; a constant to autograd.

    Where gradients are asked for, the fit goes on to rest: see :func:`with_gradients`.

    Args:
        model: Soft light or a point light, on the samples.
        shown: What they are to explain.
        iterations: At most, where no gradients are asked for.
    """
    limit, min_gain = _AT_REST if _tracked(model, shown) else (iterations, _MIN_GAIN)
    with torch.no_grad():
        return _fit(model, shown, limit, min_gain)


def _tracked(model: LightModel, shown: Shown) -> bool:
    parts = (shown.radiance, *model.known())
    return torch.is_grad_enabled() and any(part.requires_grad for part in parts)


def _fit(model: LightModel, shown: Shown, limit: int, min_gain: float) -> LightFit:
    lights, albedo = model.start(shown)
    descend = _descend_by_kernel if compiled_for(shown.radiance) else _descend
    lights, albedo = descend(model, shown, model.admit(lights), albedo, limit, min_gain)
    residual = shown.residual(albedo, model.shade(lights))
    relative = (residual.abs() / shown.level.clamp_min(1e-300))[shown.seen]
    return LightFit(model=model, lights=lights, albedo=albedo, misfit=float(relative.median()))


def _descend_by_kernel(
    model: LightModel,
    shown: Shown,
    lights: Float[Tensor, "view parameter"],
    albedo: Float[Tensor, " sample"],
    limit: int,
    min_gain: float,
) -> tuple[Float[Tensor, "view parameter"], Float[Tensor, " sample"]]:
    from pimper_torch.kernels.lights import TILE, fit

    count = len(albedo)
    lights = lights.clone(memory_format=torch.contiguous_format)
    whole = (0, -count % TILE)
    known, radiance, seen = (
        pad(each.detach().mT.to(albedo), whole).contiguous().numpy()
        for each in (torch.cat(model.known(), dim=1), shown.radiance, shown.seen)
    )
    found, level = pad(albedo, whole), shown.level.detach()
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
    return lights, found[:count]


def _descend(
    model: LightModel,
    shown: Shown,
    lights: Float[Tensor, "view parameter"],
    albedo: Float[Tensor, " sample"],
    limit: int,
    min_gain: float,
) -> tuple[Float[Tensor, "view parameter"], Float[Tensor, " sample"]]:
    """Step on lights and albedo together: alternation crawls along valleys where both mimic."""
    shading = model.shade(lights)
    residual = shown.residual(albedo, shading)
    damping = 1e-3
    for step in range(limit):
        widen = max(1.0, 4.0 * 0.7**step)
        scale = widen * shown.scale(residual)
        weight = shown.weights(residual, scale)
        cost = shown.cost(residual, scale)
        slopes = albedo[:, None, None] * model.slopes(lights)
        weighted = weight * residual
        downhill = (weighted[..., None] * slopes).sum(dim=0)
        # Active bound: the gradient points out of the feasible set.
        fixed = model.admit(lights + downhill) == lights
        normal = _normal_equations(shading, torch.where(fixed, 0, slopes), weight, damping)
        steps = normal.solve(torch.where(fixed, 0, downhill), (weighted * shading).sum(dim=1))
        moved = model.admit(lights + steps[0])
        under = model.shade(moved)
        changed = _best_albedo(shown, under, albedo + steps[1], weight, scale)
        left = shown.residual(changed, under)
        after = shown.cost(left, scale)
        if after < cost:
            lights, albedo, shading, residual = moved, changed, under, left
            damping = max(damping / 4, 1e-9)
            if widen == 1 and after > cost * (1 - min_gain):
                break
        else:
            damping = min(damping * 10, 1e6)
    return lights, albedo


def with_gradients(found: LightFit, shown: Shown) -> LightFit:
    """Give the fit gradients to photographs and geometry, if any are asked for.

    By the implicit function, at the nearest stationary point. Light and albedo share a free
    factor: the largest parameter of the lights is fixed, and so are parameters at a bound or
    without data.
    """
    if not _tracked(found.model, shown):
        return found
    model, count = found.model, found.lights.numel()
    start = torch.cat([found.lights.flatten(), found.albedo])

    def slopes(at: Float[Tensor, " unknown"]) -> Float[Tensor, " unknown"]:
        lights, albedo = at[:count].reshape(found.lights.shape), at[count:]
        shading = model.shade(lights)
        residual = shown.residual(albedo, shading)
        weighted = shown.weights(residual, shown.scale(residual)) * residual
        by_lights = torch.einsum("sv,s,svp->vp", weighted, albedo, model.slopes(lights))
        return torch.cat([by_lights.flatten(), (weighted * shading).sum(dim=1)])

    with torch.no_grad():
        shading = model.shade(found.lights)
        residual = shown.residual(found.albedo, shading)
        weight = shown.weights(residual, shown.scale(residual))
        by_lights = found.albedo[:, None, None] * model.slopes(found.lights)
        normal = _normal_equations(shading, by_lights, weight, _PRECONDITIONER_DAMPING)
        observed = (weight * shading**2).sum(dim=1) > 0
        fixed = ~torch.cat([model.free(found.lights).flatten(), observed])
        flat = found.lights.abs().flatten()
        fixed[torch.where(fixed[:count], 0, flat).argmax()] = True

    def equations(at: Float[Tensor, " unknown"]) -> Float[Tensor, " unknown"]:
        return torch.where(fixed, start - at, slopes(at))

    def precondition(side: Float[Tensor, " unknown"]) -> Float[Tensor, " unknown"]:
        inner = torch.where(fixed, 0, side)
        lights, albedo = normal.solve(inner[:count].reshape(found.lights.shape), inner[count:])
        return -torch.where(fixed, side, torch.cat([lights.flatten(), albedo]))

    solution = newton_solution(equations, start, precondition)
    answer = implicit_solution(equations, solution, precondition)
    return LightFit(
        model=model,
        lights=answer[:count].reshape(found.lights.shape),
        albedo=answer[count:],
        misfit=found.misfit,
    )


def _best_albedo(
    shown: Shown,
    shading: Float[Tensor, "sample view"],
    albedo: Float[Tensor, " sample"],
    weight: Float[Tensor, "sample view"],
    scale: Float[Tensor, " view"],
) -> Float[Tensor, " sample"]:
    """Give the albedo that suits shading best: by the weights there are, then by its own.

    Lights and albedo are multiplied, so that after a step of both at once it is not the best.
    """
    for _ in range(2):
        best = shown.albedo_under(shading, weight)
        albedo = torch.where(best.isfinite(), best, albedo)
        weight = shown.weights(shown.residual(albedo, shading), scale)
    return albedo


@dataclass(frozen=True, slots=True, kw_only=True)
class _Normal:
    """The normal equations of lights and albedos, albedos eliminated (Schur).

    Attributes:
        cross: Between albedos and the parameters of the lights.
        inverse: Of the albedos' own part.
        factor: Of what is left for the lights: ``torch.linalg.lu_factor``'s.
    """

    cross: Float[Tensor, "sample unknown"]
    inverse: Float[Tensor, " sample"]
    factor: tuple[Tensor, Tensor]

    def solve(
        self, on_lights: Float[Tensor, "view parameter"], on_albedo: Float[Tensor, " sample"]
    ) -> tuple[Float[Tensor, "view parameter"], Float[Tensor, " sample"]]:
        """Solve for both."""
        rhs = on_lights.flatten() - self.cross.mT @ (self.inverse * on_albedo)
        step = torch.linalg.lu_solve(*self.factor, rhs[:, None])[:, 0]
        return step.reshape(on_lights.shape), self.inverse * (on_albedo - self.cross @ step)


def _normal_equations(
    shading: Float[Tensor, "sample view"],
    slopes: Float[Tensor, "sample view parameter"],
    weight: Float[Tensor, "sample view"],
    damping: float,
) -> _Normal:
    """Set up Gauss-Newton's equations.

    Args:
        shading: What albedo 1 shows: the derivatives by the albedos.
        slopes: The derivatives by the parameters of the lights.
        weight: Of each residual.
        damping: Fraction of the diagonal that is added to it.
    """
    _, num_views, size = slopes.shape
    heavy = weight[..., None] * slopes
    blocks = heavy.permute(1, 2, 0) @ slopes.transpose(0, 1)
    diagonal = blocks.diagonal(dim1=1, dim2=2)
    # A view without data keeps its light: a unit block and a zero right-hand side. So does a
    # parameter without data.
    floor = 1e-9 * diagonal.sum(dim=1, keepdim=True)
    floor = torch.where(floor > 0, floor, 1)
    damped = blocks + torch.diag_embed(damping * diagonal + floor)
    own = (weight * shading**2).sum(dim=1) * (1 + damping)
    inverse = torch.where(own > 0, 1 / torch.where(own > 0, own, 1), 0)
    cross = (heavy * shading[..., None]).flatten(1)
    view = torch.arange(num_views, device=slopes.device)
    spread_out = damped.new_zeros(num_views, size, num_views, size)
    spread_out[view, :, view, :] = damped
    schur = spread_out.reshape(size * num_views, -1) - cross.mT @ (inverse[:, None] * cross)
    ridge = 1e-12 * torch.diag(schur.diagonal().abs())
    return _Normal(cross=cross, inverse=inverse, factor=torch.linalg.lu_factor(schur + ridge))
