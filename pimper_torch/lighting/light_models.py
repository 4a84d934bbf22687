"""Parametric models of each view's light, and the samples that they are fitted to.

Light is spherical harmonics and a near point light. More parameters must reduce residuals of
radiance that was held out of the fit.

Because of attached shadows, the fit of a point light's direction has many local minima: started
along the mean normal, it ended 30 to 70 degrees from the point light in six of nine views of a
potato on a table, with twice the residuals. It therefore starts from the best of all directions.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.geometry.directions import even_directions
from pimper_torch.kernels.twin_constants import CAUCHY_TUNING, MIN_DEVIATION
from pimper_torch.linalg.robust import cauchy_weights, robust_deviation

Parameters = Float[Tensor, "view parameter"]
"""Parameters of each view's light, see :class:`LightModel`."""
Entries = Float[Tensor, "sample view"]
"""A value of each sample in each view."""
Seen = Bool[Tensor, "sample view"]
Albedo = Float[Tensor, " sample"]
SampleVectors = Float[Tensor, "sample 3"]
Unknowns = tuple[Parameters, Albedo]

# Logarithms of residuals must fall by this number of standard errors over the views, 99.7 %
# confidence, and by at least this much, a choice: smaller gains on glossy scenes were not light.
_CONFIDENCE, _LEAST = 3.0, 0.05


def left_out(seen: Seen) -> Seen:
    """Return the entries to hold out: a fifth of each sample and of each view."""
    sample, view = (torch.arange(size, device=seen.device) for size in seen.shape)
    return seen & ((sample[:, None] + view) % 5 == 0)


def predicts_better(misfit: Float[Tensor, " view"], simpler: Float[Tensor, " view"]) -> bool:
    """Return whether a model predicts significantly better than a simpler one.

    Args:
        misfit: Held-out residual of each view; NaN without data.
        simpler: The same of the simpler model.
    """
    gain = (simpler / misfit).log()
    gain = gain[gain.isfinite()]
    if len(gain) < 2:
        return False
    error = float(gain.std()) / math.sqrt(len(gain))
    return float(gain.mean()) > max(_CONFIDENCE * error, _LEAST)


@dataclass(frozen=True, kw_only=True)
class ImageSamples:
    """Radiance of samples in all views.

    Attributes:
        radiance: Gray, linear; zero where not seen.
        seen: False where missing.
    """

    radiance: Entries
    seen: Seen

    def at(self, index: slice | tuple[slice, slice]) -> "ImageSamples":
        """Return a subset of samples, or of samples and views."""
        return ImageSamples(radiance=self.radiance[index], seen=self.seen[index])

    @cached_property
    def mean_radiance(self) -> Float[Tensor, " view"]:
        """Mean radiance of each view."""
        return (self.radiance.sum(dim=0) / self.seen.sum(dim=0).clamp_min(1)).abs()

    def residual(self, albedo: Albedo, shading: Entries) -> Entries:
        """Return the residuals of a model of albedo and shading; zero where not seen."""
        return torch.where(self.seen, self.radiance - albedo[:, None] * shading, 0)

    def scale(self, residual: Entries) -> Float[Tensor, " view"]:
        """Return the scale of Cauchy's loss for each view."""
        least = MIN_DEVIATION * self.mean_radiance
        return CAUCHY_TUNING * robust_deviation(residual.mT, self.seen.mT).maximum(least)

    def weights(self, residual: Entries, scale: Float[Tensor, " view"]) -> Entries:
        """Return Cauchy's weights; zero where not seen."""
        return self.seen * cauchy_weights(residual, scale)

    def brightness(self) -> tuple[Float[Tensor, " view"], Albedo]:
        """Return the median radiance of each view, and of each sample relative to these."""
        missing = torch.where(self.seen, self.radiance, torch.nan)
        gain = missing.nanmedian(dim=0).values.nan_to_num(nan=0.0)
        valid = self.seen & (gain > 0)
        ratio = torch.where(valid, self.radiance / gain.clamp_min(1e-300), torch.nan)
        albedo = ratio.nanmedian(dim=1).values.nan_to_num(nan=0.0)
        return gain, torch.where(valid.any(dim=1), albedo, 0)

    def albedo_under(self, shading: Entries, weight: Entries) -> Albedo:
        """Return the weighted least-squares albedo under a shading; NaN without weight."""
        square = (weight * shading**2).sum(dim=1)
        product = (weight * shading * self.radiance).sum(dim=1)
        return torch.where(square > 0, product / torch.where(square > 0, square, 1), torch.nan)


# Number of directions, 10 degrees apart; maximum number of samples; iterations of albedo and of the
# weights, which are low in cast shadow: no direction changed after the third.
_DIRECTIONS, _SAMPLES, _ITERATIONS = 400, 2000, 3

# Of directions whose costs differ by less than this fraction of the radiance's energy, as for
# coplanar samples, the one nearest to the mean normal is selected. A point light weaker than this
# fraction of the ambient light counts as absent, as albedo alone explains the radiance. A choice.
_TIE = 1e-3


def search_point_lights(
    samples: ImageSamples, normals: SampleVectors
) -> tuple[Float[Tensor, "view 4"], Albedo]:
    r"""Return each view's point light, assumed to be distant, by a search over directions.

    For albedo initialized by the samples' brightest views, ambient light :math:`a` and the point
    light's strength :math:`s` minimize
    :math:`\sum_i w_i (x_i - \rho_i (a + s \max(0, n_i \cdot d)))^2` in closed form for every
    direction :math:`d`. The best direction is selected; then weights and albedo are updated.

    Args:
        normals: Unit, world.

    Returns:
        Ambient light, not negative, and the point light's irradiance vector, for each view; and
        the samples' albedo. Not differentiable.
    """
    stride = -(-len(normals) // _SAMPLES)
    subset = samples.at(slice(None, None, stride))
    directions = even_directions(_DIRECTIONS).to(normals)
    facing = (normals[::stride] @ directions.mT).clamp_min(0)
    mean = normals.mean(dim=0)
    mean_direction = mean / mean.norm().clamp_min(1e-12)
    off_mean = _TIE * (1 - directions @ mean_direction)
    missing = torch.where(subset.seen, subset.radiance, torch.nan)
    # Assumes that a sample is lit in more than a fifth of the views.
    albedo = missing.nanquantile(0.8, dim=1).nan_to_num(nan=0.0)
    weight = subset.seen.to(normals)
    for _ in range(_ITERATIONS):
        ambient, strength, remaining = _fit_directions(subset, albedo, facing, weight)
        power = (weight * subset.radiance**2).sum(dim=0)[:, None]
        best = (remaining + power * off_mean).argmin(dim=1, keepdim=True)
        ambient, strength = ambient.gather(1, best)[:, 0], strength.gather(1, best)[:, 0]
        shading = ambient + strength * facing[:, best[:, 0]]
        residual = subset.residual(albedo, shading)
        weight = subset.weights(residual, subset.scale(residual))
        albedo = subset.albedo_under(shading, weight).nan_to_num(nan=0.0)
    point_light = strength[:, None] * directions[best[:, 0]]
    absent = strength <= _TIE * ambient
    point_light = torch.where(absent[:, None], ambient[:, None] * mean_direction, point_light)
    ambient = torch.where(absent, 0.2 * ambient, ambient)  # the rest is the point light's
    lights = torch.cat([ambient[:, None], point_light], dim=1)
    shading = lights[:, 0] + (normals @ lights[:, 1:].mT).clamp_min(0)
    all_albedo = samples.albedo_under(shading, samples.seen.to(normals))
    return lights, all_albedo.nan_to_num(nan=0.0)


Directions = Float[Tensor, "view direction"]


def _fit_directions(
    samples: ImageSamples,
    albedo: Albedo,
    facing: Float[Tensor, "sample direction"],
    weight: Entries,
) -> tuple[Directions, Directions, Directions]:
    """Return ambient light, strength and sum of squared residuals for every direction."""
    J = samples.radiance
    lit = albedo[:, None] * facing
    ambient_square = (weight * albedo[:, None] ** 2).sum(dim=0)[:, None]
    cross = (weight * albedo[:, None]).mT @ lit
    square = weight.mT @ lit**2
    on_ambient = (weight * J * albedo[:, None]).sum(dim=0)[:, None]
    on_light = (weight * J).mT @ lit
    tiny = torch.finfo(J.dtype).tiny
    determinant = ambient_square * square - cross**2
    independent = determinant > 1e-9 * ambient_square * square
    ambient = (on_ambient * square - on_light * cross) / determinant.clamp_min(tiny)
    # Only one of the two if they are collinear, or if the other would be negative.
    ambient = torch.where(independent, ambient, 0).clamp_min(0)
    strength = ((on_light - ambient * cross) / square.clamp_min(tiny)).clamp_min(0)
    dark = (strength == 0) | (square <= tiny)
    strength = torch.where(dark, 0, strength)
    ambient = torch.where(dark, on_ambient / ambient_square.clamp_min(tiny), ambient)
    linear = 2 * (ambient * on_ambient + strength * on_light)
    quadratic = ambient**2 * ambient_square + 2 * ambient * strength * cross + strength**2 * square
    return ambient, strength, (weight * J**2).sum(dim=0)[:, None] - linear + quadratic


# Initial and minimum distance of a point light, in mean distances of the samples from their
# centroid: choices; its irradiance has a pole, which must be outside the scene.
_FIRST_DISTANCE, MIN_DISTANCE = 10.0, 1.3


@dataclass(frozen=True, slots=True, kw_only=True)
class LightModel:
    """Soft light, constant over the scene, with or without a point light.

    Parameters of a view: coefficients of the soft light; then irradiance vector and inverse
    distance of the point light at the centroid.

    Attributes:
        basis: Spherical harmonics of the normals, or linear combinations of these.
        normals: Unit; ``None`` without point light.
        points: Relative to the centroid, in units of the scene's size.
    """

    basis: Float[Tensor, "sample term"]
    normals: SampleVectors | None = None
    points: SampleVectors | None = None

    def geometry(self) -> tuple[Tensor, ...]:
        """Return the tensors that the model is a function of."""
        tensors = self.basis, self.normals, self.points
        return tuple(tensor for tensor in tensors if tensor is not None)

    def inside_bounds(self, lights: Parameters) -> Bool[Tensor, "view parameter"]:
        """Return whether parameters are not at a bound."""
        inside = torch.ones_like(lights) > 0
        inside[:, 0] = lights[:, 0] > 0
        if self.points is not None:
            inside[:, -1] = (lights[:, -1] > 0) & (lights[:, -1] < 1 / MIN_DISTANCE)
        return inside

    def initialize(self, samples: ImageSamples) -> Unknowns:
        """Return initial lights and albedo; soft light is along the mean normal."""
        if self.normals is None:
            gain, albedo = samples.brightness()
            mean = self.basis.mean(dim=0)
            return gain[:, None] * mean / (mean @ mean).clamp_min(1e-12), albedo
        lights, albedo = search_point_lights(samples, self.normals)
        near = torch.full_like(lights[:, :1], 1 / _FIRST_DISTANCE)
        return torch.cat([lights, near], dim=1), albedo

    def shade(self, lights: Parameters) -> Entries:
        """Return the radiance of albedo 1."""
        soft = self.basis @ lights[:, : self.basis.shape[1]].mT
        if self.normals is None:
            return soft
        strength, _, away, distance = self._geometry(lights)
        facing = (self.normals[:, None] * away).sum(dim=-1)
        return soft + strength * facing.clamp_min(0) / distance**3

    def jacobian(self, lights: Parameters) -> Float[Tensor, "sample view parameter"]:
        """Return the derivatives of :meth:`shade` by the parameters of the view."""
        by_soft = self.basis[:, None].expand(-1, len(lights), -1)
        if self.normals is None or self.points is None:
            return by_soft
        strength, direction, away, distance = self._geometry(lights)
        facing = (self.normals[:, None] * away).sum(dim=-1)
        fall = distance**-3
        # Derivative of n.v / |v|^3 by v; v = d - c x, and changes of e across d rotate d.
        by_away = fall[..., None] * (
            self.normals[:, None] - 3 * (facing / distance**2)[..., None] * away
        )
        along = (by_away * direction).sum(dim=-1, keepdim=True)
        by_point_light = (facing * fall)[..., None] * direction + by_away - along * direction
        by_inverse = -strength * (by_away * self.points[:, None]).sum(dim=-1)
        lit = (facing > 0).to(facing)
        return torch.cat(
            [by_soft, lit[..., None] * by_point_light, (lit * by_inverse)[..., None]], dim=-1
        )

    def clamp(self, lights: Parameters) -> Parameters:
        """Return lights within bounds: ambient not negative, no point light inside the scene."""
        ambient = lights[:, :1].clamp_min(0)
        if self.points is None:
            return torch.cat([ambient, lights[:, 1:]], dim=1)
        inverse_distance = lights[:, -1:].clamp(0, 1 / MIN_DISTANCE)
        return torch.cat([ambient, lights[:, 1:-1], inverse_distance], dim=1)

    def _geometry(
        self, lights: Parameters
    ) -> tuple[
        Float[Tensor, " view"], Float[Tensor, "view 3"], Float[Tensor, "sample view 3"], Entries
    ]:
        assert self.points is not None
        strength = lights[:, -4:-1].norm(dim=1)
        direction = lights[:, -4:-1] / torch.where(strength > 0, strength, 1)[:, None]
        away = direction - lights[:, -1:] * self.points[:, None]
        return strength, direction, away, away.norm(dim=-1).clamp_min(1e-6)
