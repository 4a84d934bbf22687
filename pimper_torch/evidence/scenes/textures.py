"""Textures put together from others."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.evidence.scenes.scene_object import Texture


@dataclass(frozen=True, slots=True, kw_only=True)
class CylinderRegion:
    """What lies between two radii, two heights and two directions about the z axis.

    Attributes:
        radii: Scene units.
        heights: Scene units.
        azimuths_deg: Counter-clockwise from -y, where photographs are taken from.
    """

    radii: tuple[float, float] = (0.0, float("inf"))
    heights: tuple[float, float] = (-float("inf"), float("inf"))
    azimuths_deg: tuple[float, float] = (-180.0, 180.0)

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Find which points are inside."""
        x, y, height = points.unbind(dim=-1)
        radius = (x**2 + y**2).sqrt()
        azimuth = torch.rad2deg(torch.atan2(x, -y))
        inside = torch.ones_like(height, dtype=torch.bool)
        for value, (low, high) in (
            (radius, self.radii),
            (height, self.heights),
            (azimuth, self.azimuths_deg),
        ):
            inside = inside & (value >= low) & (value <= high)
        return inside


@dataclass(frozen=True, slots=True, kw_only=True)
class Uniform:
    """One albedo everywhere.

    Attributes:
        albedo: Linear; one number a channel.
    """

    albedo: tuple[float, ...]

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch channel"]:
        """Return the albedo at points."""
        return points.new_tensor(self.albedo).expand(*points.shape[:-1], -1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Painted:
    """One texture with another on top of it in some places."""

    base: Texture
    paint: Texture
    where: CylinderRegion

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch channel"]:
        """Return the albedo at points."""
        return torch.where(self.where(points)[..., None], self.paint(points), self.base(points))


@dataclass(frozen=True, slots=True, kw_only=True)
class Marked:
    """One texture darkened by another, such as by blemishes.

    Attributes:
        base: Multiplied by the marks.
        marks: 1 where there are none.
    """

    base: Texture
    marks: Texture

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch channel"]:
        """Return the albedo at points."""
        return self.base(points) * self.marks(points)
