"""Models of one view's light, as functions of a few parameters: soft light, and a point light."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.photometry.point_light_search import search_point_lights
from pimper_torch.photometry.shown import Shown

# A point light starts this far away, in mean distances of the samples from their centre, and comes
# no nearer than the second: inside the scene its light has a pole.
_FIRST_DISTANCE, MIN_DISTANCE = 10.0, 1.3


@dataclass(frozen=True, slots=True, kw_only=True)
class SoftLight:
    """First-order harmonics, the same all over the scene."""

    basis: Float[Tensor, "sample 4"]

    def known(self) -> tuple[Tensor, ...]:
        """List what the model is made from."""
        return (self.basis,)

    def free(self, lights: Float[Tensor, "view 4"]) -> Bool[Tensor, "view 4"]:
        """Mark parameters that no bound holds."""
        return torch.cat([lights[:, :1] > 0, torch.ones_like(lights[:, 1:]) > 0], dim=1)

    def start(self, shown: Shown) -> tuple[Float[Tensor, "view 4"], Float[Tensor, " sample"]]:
        """Give lights along the mean normal under which views are as bright as they are.

        Returns:
            The lights, and the albedo that goes with them.
        """
        gain, albedo = shown.brightness()
        mean = self.basis.mean(dim=0)
        return gain[:, None] * mean / (mean @ mean).clamp_min(1e-12), albedo

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
class PointLight:
    """Ambient light, the point light's irradiance vector ``e`` at the centre, and its closeness."""

    normals: Float[Tensor, "sample 3"]
    points: Float[Tensor, "sample 3"]  # about the centre, in units of the scene's size

    def known(self) -> tuple[Tensor, ...]:
        """List what the model is made from."""
        return self.normals, self.points

    def free(self, lights: Float[Tensor, "view 5"]) -> Bool[Tensor, "view 5"]:
        """Mark parameters that are not at a bound."""
        inner = (lights[:, 4:] > 0) & (lights[:, 4:] < 1 / MIN_DISTANCE)
        return torch.cat([lights[:, :1] > 0, torch.ones_like(lights[:, 1:4]) > 0, inner], dim=1)

    def start(self, shown: Shown) -> tuple[Float[Tensor, "view 5"], Float[Tensor, " sample"]]:
        """Search distant point lights, as in :mod:`~pimper_torch.photometry.point_light_search`.

        Returns:
            The lights, and the albedo that goes with them.
        """
        lights, albedo = search_point_lights(shown, self.normals)
        near = torch.full_like(lights[:, :1], 1 / _FIRST_DISTANCE)
        return torch.cat([lights, near], dim=1), albedo

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
        by_point_light = (facing * fall)[..., None] * direction + by_away - along * direction
        by_closeness = -strength * (by_away * self.points[:, None]).sum(dim=-1)
        lit = (facing > 0).to(facing)
        ones = torch.ones_like(facing)[..., None]
        return torch.cat(
            [ones, lit[..., None] * by_point_light, (lit * by_closeness)[..., None]], dim=-1
        )

    def admit(self, lights: Float[Tensor, "view 5"]) -> Float[Tensor, "view 5"]:
        """Give the nearest parameters that make sense: point lights outside the scene."""
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
