"""Parametric models of each view's light: first-order harmonics, and a point light."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.photometry.image_samples import ImageSamples
from pimper_torch.photometry.point_light_search import search_point_lights

# Initial and minimum distance of a point light, in mean distances of the samples from their
# centroid: choices; inside the scene its irradiance has a pole.
_FIRST_DISTANCE, MIN_DISTANCE = 10.0, 1.3


@dataclass(frozen=True, slots=True, kw_only=True)
class SoftLight:
    """Soft light: first-order spherical harmonics, constant over the scene."""

    basis: Float[Tensor, "sample 4"]

    def geometry(self) -> tuple[Tensor, ...]:
        """List the tensors that the model is a function of."""
        return (self.basis,)

    def inside_bounds(self, lights: Float[Tensor, "view 4"]) -> Bool[Tensor, "view 4"]:
        """Find parameters that are not at a bound."""
        return torch.cat([lights[:, :1] > 0, torch.ones_like(lights[:, 1:]) > 0], dim=1)

    def initialize(
        self, samples: ImageSamples
    ) -> tuple[Float[Tensor, "view 4"], Float[Tensor, " sample"]]:
        """Return lights along the mean normal with the views' median brightness, and albedo."""
        gain, albedo = samples.brightness()
        mean = self.basis.mean(dim=0)
        return gain[:, None] * mean / (mean @ mean).clamp_min(1e-12), albedo

    def shade(self, lights: Float[Tensor, "view 4"]) -> Float[Tensor, "sample view"]:
        """Return the radiance of albedo 1."""
        return self.basis @ lights.mT

    def jacobian(self, lights: Float[Tensor, "view 4"]) -> Float[Tensor, "sample view 4"]:
        """Return the derivatives of :meth:`shade` by the view's parameters."""
        return self.basis[:, None].expand(-1, len(lights), -1)

    def clamp(self, lights: Float[Tensor, "view 4"]) -> Float[Tensor, "view 4"]:
        """Project the parameters on their bounds: ambient light is not negative."""
        return torch.cat([lights[:, :1].clamp_min(0), lights[:, 1:]], dim=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class PointLight:
    """Ambient light, and a point light's irradiance vector and inverse distance at the centroid."""

    normals: Float[Tensor, "sample 3"]
    points: Float[Tensor, "sample 3"]  # relative to the centroid, in units of the scene's size

    def geometry(self) -> tuple[Tensor, ...]:
        """List the tensors that the model is a function of."""
        return self.normals, self.points

    def inside_bounds(self, lights: Float[Tensor, "view 5"]) -> Bool[Tensor, "view 5"]:
        """Find parameters that are not at a bound."""
        inner = (lights[:, 4:] > 0) & (lights[:, 4:] < 1 / MIN_DISTANCE)
        return torch.cat([lights[:, :1] > 0, torch.ones_like(lights[:, 1:4]) > 0, inner], dim=1)

    def initialize(
        self, samples: ImageSamples
    ) -> tuple[Float[Tensor, "view 5"], Float[Tensor, " sample"]]:
        """Return lights and albedo from a search over directions; see ``point_light_search``."""
        lights, albedo = search_point_lights(samples, self.normals)
        near = torch.full_like(lights[:, :1], 1 / _FIRST_DISTANCE)
        return torch.cat([lights, near], dim=1), albedo

    def shade(self, lights: Float[Tensor, "view 5"]) -> Float[Tensor, "sample view"]:
        """Return the radiance of albedo 1."""
        strength, _, away, distance = self._geometry(lights)
        facing = (self.normals[:, None] * away).sum(dim=-1)
        return lights[:, 0] + strength * facing.clamp_min(0) / distance**3

    def jacobian(self, lights: Float[Tensor, "view 5"]) -> Float[Tensor, "sample view 5"]:
        """Return the derivatives of :meth:`shade` by the view's parameters."""
        strength, direction, away, distance = self._geometry(lights)
        facing = (self.normals[:, None] * away).sum(dim=-1)
        fall = distance**-3
        # Of n.v / |v|^3 by v; v = d - c x, and d rotates with the part of e across it.
        by_away = fall[..., None] * (
            self.normals[:, None] - 3 * (facing / distance**2)[..., None] * away
        )
        along = (by_away * direction).sum(dim=-1, keepdim=True)
        by_point_light = (facing * fall)[..., None] * direction + by_away - along * direction
        by_closeness = -strength * (by_away * self.points[:, None]).sum(dim=-1)
        lit = (facing > 0).to(facing)
        ones = torch.ones_like(facing)[..., None]
        return torch.cat(
            [ones, lit[..., None] * by_point_light, (lit * by_closeness)[..., None]], dim=-1
        )

    def clamp(self, lights: Float[Tensor, "view 5"]) -> Float[Tensor, "view 5"]:
        """Project the parameters on their bounds: point lights stay outside the scene."""
        ambient = lights[:, :1].clamp_min(0)
        closeness = lights[:, 4:].clamp(0, 1 / MIN_DISTANCE)
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


LightModel = SoftLight | PointLight
