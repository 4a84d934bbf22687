r"""The light of every view, from normals that are already known.

The coarse mesh knows the shape to a few degrees; that is enough to calibrate lights, and
lights that are calibrated leave no ambiguity for the factorization.

Two models are fitted, and the one that explains the photographs better is taken: soft light,
the same first-order harmonics all over the scene; and a lamp at some place, whose light
falls off, with attached shadows and an ambient term. One light for all, linear in
:math:`(1, n)`, is no model for a lamp: its falling off and its shadows are taken for shape.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.linalg.implicit import implicit_solution, newton_solution
from pimper_torch.photometry.harmonics import harmonics
from pimper_torch.photometry.light_field import LightField
from pimper_torch.photometry.robust import cauchy_weights, smooth_spread

# Cauchy's weights are 95 % efficient on Gaussian noise with this many standard deviations.
CAUCHY_TUNING = 2.385

# A lamp starts this far away, in mean distances of the samples from their middle, and comes no
# nearer than the second: inside the scene its light has a pole.
_FIRST_DISTANCE, _LEAST_DISTANCE = 10.0, 1.3

# A fit is done when a step lowers its cost by less than this share; and iterations and share where
# gradients are asked for, from which Newton's method goes on.
_LEAST_GAIN, _AT_REST = 1e-7, (300, 1e-13)

# Share of the diagonal that is added to the normal equations where they precondition others: that
# light and albedo share a factor makes them singular.
_CLOSE = 1e-6

# A lamp has one number more than soft light, and must leave smaller residuals than this share.
_LAMP_GAIN = 0.95


def fit_light_field(
    radiance: Float[Tensor, "sample view"],
    seen: Bool[Tensor, "sample view"],
    normals: Float[Tensor, "sample 3"],
    points: Float[Tensor, "sample 3"] | None = None,
    model: Literal["auto", "soft", "lamp"] = "auto",
    iterations: int = 60,
) -> LightField:
    r"""Fit soft light or lamps, or both, and take what leaves the smaller residuals.

    Minimised is :math:`\sum_{ig} \phi(x_{gi} - \rho_i\, s_g(i))`, :math:`\phi` being Cauchy's
    loss with a scale of 2.385 spreads of the view's residuals (wider at first).

    Args:
        radiance: Gray, linear. Entries that are not seen do not matter.
        seen: False where missing.
        normals: Unit, world.
        points: World; without, lamps are far away.
        model: Which to fit; ``auto`` is both.
        iterations: At most, for each model.

    Returns:
        The scale between light and albedo is free; here the median of ``|l|`` over the views,
        at the middle of the points, is 1. A view without data has zero.

    Fails where the normals span too little (a plane shows one number of each soft light): the
    answer is then the smallest change from lights that shine along the mean normal, and
    lights that differ are found parallel. Computed in float64. Differentiable by the implicit
    function; which model is taken, and what is held at a bound, is constant.

    Source: of the lamp, Queau et al., LED-based photometric stereo, JMIV 60, 2018; that it is
    calibrated by the coarse shape is ours.
    """
    views = radiance.shape[1]
    if not seen.any():
        return LightField(
            origin=radiance.new_zeros(3),
            soft=radiance.new_zeros(views, 4),
            lamp=radiance.new_zeros(views, 3),
            closeness=radiance.new_zeros(views),
        )
    some = seen.any(dim=1)
    seen = seen[some]
    J = torch.where(seen, radiance[some], 0).double()
    known = normals[some].double()
    places = torch.zeros_like(known) if points is None else points[some].double()
    origin = places.mean(dim=0)
    size = _extent(places - origin)
    soft = lamp = None
    if model != "lamp":
        soft = _fitted(_Soft(basis=harmonics(known)), J, seen, iterations)
    if model != "soft":
        lamp = _fitted(_Lamp(normals=known, points=(places - origin) / size), J, seen, iterations)
    lights = torch.zeros(views, 4).to(J)
    lamps, closeness = torch.zeros_like(lights[:, 1:]), torch.zeros_like(lights[:, 0])
    if lamp is None or (soft is not None and lamp.misfit >= _LAMP_GAIN * soft.misfit):
        assert soft is not None
        lights = soft.answering(J, seen).lights
    else:
        told = lamp.answering(J, seen).lights
        lights = torch.cat([told[:, :1], lights[:, 1:]], dim=1)
        lamps = told[:, 1:4]
        closeness = torch.zeros_like(closeness) if points is None else told[:, 4] / size
    factor = _typical(lights.square().sum(dim=1) + lamps.square().sum(dim=1))
    return LightField(
        origin=origin.to(radiance),
        soft=(lights / factor).to(radiance),
        lamp=(lamps / factor).to(radiance),
        closeness=closeness.to(radiance),
    )


def fit_distant_lights(
    radiance: Float[Tensor, "sample view"],
    seen: Bool[Tensor, "sample view"],
    normals: Float[Tensor, "sample 3"],
) -> Float[Tensor, "view 4"]:
    """Fit lights that are the same everywhere; see :func:`fit_light_field`.

    Returns:
        First-order lights in the frame of the normals, of what faces the lamp.
    """
    field = fit_light_field(radiance, seen, normals)
    return field.lights_at(field.origin[None])[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Soft:
    """First-order harmonics, the same all over the scene."""

    basis: Float[Tensor, "sample 4"]

    def known(self) -> tuple[Tensor, ...]:
        """List what the model is made from."""
        return (self.basis,)

    def free(self, lights: Float[Tensor, "view 4"]) -> Bool[Tensor, "view 4"]:
        """Mark parameters that no bound holds."""
        return torch.cat([lights[:, :1] > 0, torch.ones_like(lights[:, 1:]) > 0], dim=1)

    def start(self, gain: Float[Tensor, " view"]) -> Float[Tensor, "view 4"]:
        """Give lights along the mean normal under which views are as bright as they are."""
        mean = self.basis.mean(dim=0)
        return gain[:, None] * mean / (mean @ mean).clamp_min(1e-12)

    def shade(self, lights: Float[Tensor, "view 4"]) -> Float[Tensor, "sample view"]:
        """Give the radiance of albedo 1."""
        return self.basis @ lights.mT

    def slopes(self, lights: Float[Tensor, "view 4"]) -> Float[Tensor, "sample view 4"]:
        """Give its derivatives by the view's parameters."""
        return self.basis[:, None].expand(-1, len(lights), -1)

    def admit(self, lights: Float[Tensor, "view 4"]) -> Float[Tensor, "view 4"]:
        """Give the nearest parameters that make sense: light from everywhere is not negative."""
        return torch.cat([lights[:, :1].clamp_min(0), lights[:, 1:]], dim=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Lamp:
    """Ambient light, the lamp's irradiance vector ``e`` at the middle, and its closeness."""

    normals: Float[Tensor, "sample 3"]
    points: Float[Tensor, "sample 3"]  # about the middle, in units of the scene's size

    def known(self) -> tuple[Tensor, ...]:
        """List what the model is made from."""
        return self.normals, self.points

    def free(self, lights: Float[Tensor, "view 5"]) -> Bool[Tensor, "view 5"]:
        """Mark parameters that no bound holds."""
        inner = (lights[:, 4:] > 0) & (lights[:, 4:] < 1 / _LEAST_DISTANCE)
        return torch.cat([lights[:, :1] > 0, torch.ones_like(lights[:, 1:4]) > 0, inner], dim=1)

    def start(self, gain: Float[Tensor, " view"]) -> Float[Tensor, "view 5"]:
        """Give distant lamps along the mean normal, and a fifth of their light as ambient."""
        mean = self.normals.mean(dim=0)
        direction = mean / mean.norm().clamp_min(1e-12)
        lamp = gain[:, None] * direction
        return torch.cat(
            [0.2 * gain[:, None], lamp, torch.full_like(lamp[:, :1], 1 / _FIRST_DISTANCE)], dim=1
        )

    def shade(self, lights: Float[Tensor, "view 5"]) -> Float[Tensor, "sample view"]:
        """Give the radiance of albedo 1."""
        strength, _, away, distance = self._geometry(lights)
        facing = (self.normals[:, None] * away).sum(dim=-1)
        return lights[:, 0] + strength * facing.clamp_min(0) / distance**3

    def slopes(self, lights: Float[Tensor, "view 5"]) -> Float[Tensor, "sample view 5"]:
        """Give its derivatives by the view's parameters."""
        strength, direction, away, distance = self._geometry(lights)
        facing = (self.normals[:, None] * away).sum(dim=-1)
        fall = distance**-3
        # Of n.v / |v|^3 by v; v = d - c x, and d turns with e across its own direction.
        by_away = fall[..., None] * (
            self.normals[:, None] - 3 * (facing / distance**2)[..., None] * away
        )
        along = (by_away * direction).sum(dim=-1, keepdim=True)
        by_lamp = (facing * fall)[..., None] * direction + by_away - along * direction
        by_closeness = -strength * (by_away * self.points[:, None]).sum(dim=-1)
        lit = (facing > 0).to(facing)
        ones = torch.ones_like(facing)[..., None]
        return torch.cat([ones, lit[..., None] * by_lamp, (lit * by_closeness)[..., None]], dim=-1)

    def admit(self, lights: Float[Tensor, "view 5"]) -> Float[Tensor, "view 5"]:
        """Give the nearest parameters that make sense: lamps outside the scene."""
        ambient = lights[:, :1].clamp_min(0)
        closeness = lights[:, 4:].clamp(0, 1 / _LEAST_DISTANCE)
        return torch.cat([ambient, lights[:, 1:4], closeness], dim=1)

    def _geometry(
        self, lights: Float[Tensor, "view 5"]
    ) -> tuple[
        Float[Tensor, " view"],
        Float[Tensor, "view 3"],
        Float[Tensor, "sample view 3"],
        Float[Tensor, "sample view"],
    ]:
        strength = lights[:, 1:4].norm(dim=1)
        direction = lights[:, 1:4] / torch.where(strength > 0, strength, 1)[:, None]
        away = direction - lights[:, 4:] * self.points[:, None]
        return strength, direction, away, away.norm(dim=-1).clamp_min(1e-6)


_Model = _Soft | _Lamp


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    """A fit, and its median residual as a share of the view's brightness."""

    model: _Model
    lights: Float[Tensor, "view parameter"]
    albedo: Float[Tensor, " sample"]
    misfit: float

    def answering(
        self, J: Float[Tensor, "sample view"], seen: Bool[Tensor, "sample view"]
    ) -> "_Found":
        """Give the fit with gradients to the photographs and to what the model knows, if asked."""
        return _with_gradients(self, J, seen) if _asked(self.model, J) else self


def _asked(model: _Model, J: Float[Tensor, "sample view"]) -> bool:
    """Tell whether gradients are asked for."""
    parts = (J, *model.known())
    return torch.is_grad_enabled() and any(part.requires_grad for part in parts)


def _fitted(
    model: _Model, J: Float[Tensor, "sample view"], seen: Bool[Tensor, "sample view"], limit: int
) -> _Found:
    """Fit a model; to rest where gradients are asked for."""
    limit, least_gain = _AT_REST if _asked(model, J) else (limit, _LEAST_GAIN)
    with torch.no_grad():
        return _fit(model, J, seen, limit, least_gain)


def _fit(
    model: _Model,
    J: Float[Tensor, "sample view"],
    seen: Bool[Tensor, "sample view"],
    limit: int,
    least_gain: float,
) -> _Found:
    """Take damped Gauss-Newton steps on lights and albedo together, albedos eliminated.

    Alternation would crawl along the valleys where albedo mimics light.
    """
    gain, albedo = _brightness(J, seen)
    lights = model.admit(model.start(gain))
    shading = model.shade(lights)
    residual = torch.where(seen, J - albedo[:, None] * shading, 0)
    damping = 1e-3
    for step in range(limit):
        widen = max(1.0, 4.0 * 0.7**step)
        scale = widen * _scale(J, seen, residual)
        weight = seen * cauchy_weights(residual, scale)
        cost = _cost(seen, residual, scale)
        slopes = albedo[:, None, None] * model.slopes(lights)
        downhill = ((weight * residual)[..., None] * slopes).sum(dim=0)
        # A parameter that would only be pushed over its bound stays out of the others' way.
        slopes = torch.where(model.admit(lights + downhill) == lights, 0, slopes)
        lights_step, albedo_step = _step(shading, slopes, residual, weight, damping)
        moved = model.admit(lights + lights_step)
        shown = model.shade(moved)
        changed = _best_albedo(J, seen, shown, albedo + albedo_step, weight, scale)
        left = torch.where(seen, J - changed[:, None] * shown, 0)
        after = _cost(seen, left, scale)
        if after < cost:
            lights, albedo, shading, residual = moved, changed, shown, left
            damping = max(damping / 4, 1e-9)
            if widen == 1 and after > cost * (1 - least_gain):
                break
        else:
            damping = min(damping * 10, 1e6)
    relative = residual.abs() / _level(J, seen).clamp_min(1e-300)
    return _Found(model=model, lights=lights, albedo=albedo, misfit=float(relative[seen].median()))


def _with_gradients(
    found: _Found, J: Float[Tensor, "sample view"], seen: Bool[Tensor, "sample view"]
) -> _Found:
    """Give the fit its gradients by the implicit function, at the nearest stationary point.

    One number is free, as light and albedo share a factor: the largest of the lights' keeps its
    value, and so does what a bound holds or nothing tells.
    """
    model, count = found.model, found.lights.numel()
    start = torch.cat([found.lights.flatten(), found.albedo])

    def slopes(at: Float[Tensor, " unknown"]) -> Float[Tensor, " unknown"]:
        lights, albedo = at[:count].reshape(found.lights.shape), at[count:]
        shown = model.shade(lights)
        residual = torch.where(seen, J - albedo[:, None] * shown, 0)
        heavy = seen * cauchy_weights(residual, _scale(J, seen, residual)) * residual
        by_lights = torch.einsum("sv,s,svp->vp", heavy, albedo, model.slopes(lights))
        return torch.cat([by_lights.flatten(), (heavy * shown).sum(dim=1)])

    with torch.no_grad():
        shown = model.shade(found.lights)
        residual = torch.where(seen, J - found.albedo[:, None] * shown, 0)
        weight = seen * cauchy_weights(residual, _scale(J, seen, residual))
        normal = _normal_equations(
            shown, found.albedo[:, None, None] * model.slopes(found.lights), weight, _CLOSE
        )
        held = ~torch.cat([model.free(found.lights).flatten(), (weight * shown**2).sum(dim=1) > 0])
        flat = found.lights.abs().flatten()
        held[torch.where(held[:count], 0, flat).argmax()] = True

    def equations(at: Float[Tensor, " unknown"]) -> Float[Tensor, " unknown"]:
        return torch.where(held, start - at, slopes(at))

    def precondition(side: Float[Tensor, " unknown"]) -> Float[Tensor, " unknown"]:
        inner = torch.where(held, 0, side)
        lights, albedo = normal.solve(inner[:count].reshape(found.lights.shape), inner[count:])
        return -torch.where(held, side, torch.cat([lights.flatten(), albedo]))

    solution = newton_solution(equations, start, precondition)
    answer = implicit_solution(equations, solution, precondition)
    return _Found(
        model=model,
        lights=answer[:count].reshape(found.lights.shape),
        albedo=answer[count:],
        misfit=found.misfit,
    )


def _best_albedo(
    J: Float[Tensor, "sample view"],
    seen: Bool[Tensor, "sample view"],
    shading: Float[Tensor, "sample view"],
    albedo: Float[Tensor, " sample"],
    weight: Float[Tensor, "sample view"],
    scale: Float[Tensor, " view"],
) -> Float[Tensor, " sample"]:
    """Give the albedo that suits shading best: by the weights there are, then by its own.

    Lights and albedo are multiplied, so that after a step of both at once it is not the best.
    """
    for _ in range(2):
        square = (weight * shading**2).sum(dim=1)
        product = (weight * shading * torch.where(seen, J, 0)).sum(dim=1)
        albedo = torch.where(square > 0, product / torch.where(square > 0, square, 1), albedo)
        residual = torch.where(seen, J - albedo[:, None] * shading, 0)
        weight = seen * cauchy_weights(residual, scale)
    return albedo


def _brightness(
    J: Float[Tensor, "sample view"], seen: Bool[Tensor, "sample view"]
) -> tuple[Float[Tensor, " view"], Float[Tensor, " sample"]]:
    """Take robust brightnesses of views, and of samples relative to their views."""
    missing = torch.where(seen, J, torch.nan)
    gain = missing.nanmedian(dim=0).values.nan_to_num(nan=0.0)
    ratio = torch.where(seen & (gain > 0), J / gain.clamp_min(1e-300), torch.nan)
    albedo = ratio.nanmedian(dim=1).values.nan_to_num(nan=0.0)
    return gain, torch.where((seen * gain > 0).any(dim=1), albedo, 0)


def _level(
    J: Float[Tensor, "sample view"], seen: Bool[Tensor, "sample view"]
) -> Float[Tensor, " view"]:
    return (J.sum(dim=0) / seen.sum(dim=0).clamp_min(1)).abs()


def _scale(
    J: Float[Tensor, "sample view"],
    seen: Bool[Tensor, "sample view"],
    residual: Float[Tensor, "sample view"],
) -> Float[Tensor, " view"]:
    return CAUCHY_TUNING * smooth_spread(residual.mT, seen.mT).maximum(1e-4 * _level(J, seen))


def _cost(
    seen: Bool[Tensor, "sample view"],
    residual: Float[Tensor, "sample view"],
    scale: Float[Tensor, " view"],
) -> float:
    relative = residual / torch.where(scale > 0, scale, 1)
    return float((seen * scale**2 * torch.log1p(relative**2)).sum())


def _step(
    shading: Float[Tensor, "sample view"],
    slopes: Float[Tensor, "sample view parameter"],
    residual: Float[Tensor, "sample view"],
    weight: Float[Tensor, "sample view"],
    damping: float,
) -> tuple[Float[Tensor, "view parameter"], Float[Tensor, " sample"]]:
    """Give what to add to lights and albedos.

    Args:
        shading: What albedo 1 shows: the derivatives by the albedos.
        slopes: The derivatives by the parameters of the lights.
        residual: What is left to explain.
        weight: Of each.
        damping: Share of the diagonal that is added to it.
    """
    on_lights = ((weight * residual)[..., None] * slopes).sum(dim=0)
    on_albedo = (weight * residual * shading).sum(dim=1)
    return _normal_equations(shading, slopes, weight, damping).solve(on_lights, on_albedo)


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
    """Set up Gauss-Newton's equations; see :func:`_step`."""
    _, num_views, size = slopes.shape
    heavy = weight[..., None] * slopes
    blocks = heavy.permute(1, 2, 0) @ slopes.transpose(0, 1)
    diagonal = blocks.diagonal(dim1=1, dim2=2)
    # A view without data keeps its light: a unit block, and nothing on the right. So does a
    # parameter that nothing tells.
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


def _extent(places: Float[Tensor, "sample 3"]) -> Float[Tensor, ""]:
    """Give the mean distance of places from their middle, 1 if all are one."""
    apart = places[(places != 0).any(dim=1)]
    return apart.norm(dim=1).sum() / len(places) if len(apart) else places.new_ones(())


def _typical(square: Float[Tensor, " view"]) -> Float[Tensor, ""]:
    """Give the median length of lights, from the squares of those that shine."""
    shining = square[square > 0]
    return shining.sqrt().median() if len(shining) else square.new_ones(())
