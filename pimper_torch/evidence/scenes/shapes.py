"""Shapes whose rays are met in closed form, and so exactly.

The world's z points up and out of the flat ones; normals are unit and outward.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize


@runtime_checkable
class Shape(Protocol):
    """A surface in the world."""

    def intersect(
        self, origins: Float[Tensor, "*#batch 3"], directions: Float[Tensor, "*#batch 3"]
    ) -> Float[Tensor, "*batch"]:
        """Return the distance to the first hit in lengths of the direction; infinite if none."""

    def normals(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Return the outward unit normals at points of the surface."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sphere:
    """A ball round a centre."""

    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 1.0

    def intersect(
        self, origins: Float[Tensor, "*#batch 3"], directions: Float[Tensor, "*#batch 3"]
    ) -> Float[Tensor, "*batch"]:
        """Solve the quadratic; the nearer root in front of the origin is the hit."""
        offset = origins - origins.new_tensor(self.center)
        a = (directions * directions).sum(-1)
        b = (offset * directions).sum(-1)
        c = (offset * offset).sum(-1) - self.radius**2
        discriminant = b * b - a * c
        root = discriminant.clamp_min(0).sqrt()
        near, far = (-b - root) / a, (-b + root) / a
        distance = torch.where(near > 0, near, far)
        return torch.where((discriminant >= 0) & (distance > 0), distance, torch.inf)

    def normals(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Point away from the centre."""
        return normalize(points - points.new_tensor(self.center), dim=-1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plane:
    """An endless plane through a point; both sides are seen."""

    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def intersect(
        self, origins: Float[Tensor, "*#batch 3"], directions: Float[Tensor, "*#batch 3"]
    ) -> Float[Tensor, "*batch"]:
        """Divide height by descent."""
        normal = origins.new_tensor(self.normal)
        height = ((origins - origins.new_tensor(self.point)) * normal).sum(-1)
        distance = -height / (directions * normal).sum(-1)
        return torch.where((distance > 0) & distance.isfinite(), distance, torch.inf)

    def normals(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Repeat the plane's own."""
        return normalize(points.new_tensor(self.normal), dim=-1).expand_as(points)
