"""Parametric models of each view's light: spherical harmonics, and a near point light."""

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
class LightModel:
    """Soft light, constant over the scene, and a point light or none.

    Parameters of a view: coefficients of the soft light; then, of the point light, irradiance
    vector and inverse distance at the centroid.

    Attributes:
        basis: Spherical harmonics of the normals, or a mixture of them.
        normals: Unit; ``None`` without point light.
        points: Relative to the centroid, in units of the scene's size.
    """

    basis: Float[Tensor, "sample term"]
    normals: Float[Tensor, "sample 3"] | None = None
    points: Float[Tensor, "sample 3"] | None = None

    def geometry(self) -> tuple[Tensor, ...]:
        """List the tensors that the model is a function of."""
        parts = self.basis, self.normals, self.points
        return tuple(part for part in parts if part is not None)

    def inside_bounds(
        self, lights: Float[Tensor, "view parameter"]
    ) -> Bool[Tensor, "view parameter"]:
        """Find parameters that are not at a bound."""
        inside = torch.ones_like(lights) > 0
        inside[:, 0] = lights[:, 0] > 0
        if self.points is not None:
            inside[:, -1] = (lights[:, -1] > 0) & (lights[:, -1] < 1 / MIN_DISTANCE)
        return inside

    def initialize(
        self, samples: ImageSamples
    ) -> tuple[Float[Tensor, "view parameter"], Float[Tensor, " sample"]]:
        """Return initial lights and albedo.

        Soft light is along the mean normal with the views' median brightness. Of ambient and a
        point light see ``point_light_search``.
        """
        if self.normals is None:
            gain, albedo = samples.brightness()
            mean = self.basis.mean(dim=0)
            return gain[:, None] * mean / (mean @ mean).clamp_min(1e-12), albedo
        lights, albedo = search_point_lights(samples, self.normals)
        near = torch.full_like(lights[:, :1], 1 / _FIRST_DISTANCE)
        return torch.cat([lights, near], dim=1), albedo

    def shade(self, lights: Float[Tensor, "view parameter"]) -> Float[Tensor, "sample view"]:
        """Return the radiance of albedo 1."""
        soft = self.basis @ lights[:, : self.basis.shape[1]].mT
        if self.normals is None:
            return soft
        strength, _, away, distance = self._geometry(lights)
        facing = (self.normals[:, None] * away).sum(dim=-1)
        return soft + strength * facing.clamp_min(0) / distance**3

    def jacobian(
        self, lights: Float[Tensor, "view parameter"]
    ) -> Float[Tensor, "sample view parameter"]:
        """Return the derivatives of :meth:`shade` by the view's parameters."""
        by_soft = self.basis[:, None].expand(-1, len(lights), -1)
        if self.normals is None or self.points is None:
            return by_soft
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
        return torch.cat(
            [by_soft, lit[..., None] * by_point_light, (lit * by_closeness)[..., None]], dim=-1
        )

    def clamp(self, lights: Float[Tensor, "view parameter"]) -> Float[Tensor, "view parameter"]:
        """Project on the bounds: no negative ambient light, no point light inside the scene."""
        ambient = lights[:, :1].clamp_min(0)
        if self.points is None:
            return torch.cat([ambient, lights[:, 1:]], dim=1)
        closeness = lights[:, -1:].clamp(0, 1 / MIN_DISTANCE)
        return torch.cat([ambient, lights[:, 1:-1], closeness], dim=1)

    def _geometry(
        self, lights: Float[Tensor, "view parameter"]
    ) -> tuple[
        Float[Tensor, " view"],
        Float[Tensor, "view 3"],
        Float[Tensor, "sample view 3"],
        Float[Tensor, "sample view"],
    ]:
        assert self.points is not None
        strength = lights[:, -4:-1].norm(dim=1)
        direction = lights[:, -4:-1] / torch.where(strength > 0, strength, 1)[:, None]
        away = direction - lights[:, -1:] * self.points[:, None]
        return strength, direction, away, away.norm(dim=-1).clamp_min(1e-6)
