"""Normals and albedo rendered from one viewpoint under many distant lights, camera frame."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class OneView(Record):
    """Photographs from one viewpoint, with the true normals, albedo and lights.

    Attributes:
        normals: Unit, of the pixels inside the mask in raster order.
    """

    images: Float[Tensor, "view channel height width"]
    mask: Bool[Tensor, "height width"]
    normals: Float[Tensor, "3 pixel"]
    albedo: Float[Tensor, "channel pixel"]
    lights: Float[Tensor, "view 3"]

    @property
    def shading(self) -> Float[Tensor, "3 pixel"]:
        """Albedo, summed over channels, times normal."""
        return self.albedo.sum(dim=0) * self.normals


def photograph(
    normals: Float[Tensor, "height width 3"],
    albedo: Float[Tensor, "height width channel"],
    mask: Bool[Tensor, "height width"],
    lights: Float[Tensor, "view 3"],
    generator: torch.Generator,
    noise: float = 0.0,
) -> OneView:
    """Render a Lambertian surface, attached shadows black.

    Args:
        noise: Standard deviation of Gaussian noise, as a fraction of the maximum; added before
            negative values are clipped.
    """
    n, rho = normals[mask].mT, albedo[mask].mT
    values = (lights @ n).clamp_min(0)[:, None] * rho
    drawn = torch.randn(values.shape, generator=generator, dtype=torch.float64).to(values)
    values = (values + noise * values.max() * drawn).clamp_min(0)
    images = values.new_zeros(*values.shape[:2], *mask.shape)
    images[..., mask] = values
    return OneView(images=images, mask=mask, normals=n, albedo=rho, lights=lights)


def point_lights(
    views: int, generator: torch.Generator, widest_deg: float = 50.0
) -> Float[Tensor, "view 3"]:
    """Draw distant point lights evenly over the cap around the view, of strength 0.7 to 1.3."""
    widest = torch.cos(torch.deg2rad(torch.tensor(widest_deg, dtype=torch.float64)))
    drawn = torch.rand(3, views, generator=generator, dtype=torch.float64)
    z = 1 - (1 - widest) * drawn[0]
    angle, radius = 2 * torch.pi * drawn[1], (1 - z * z).sqrt()
    directions = torch.stack([radius * angle.cos(), radius * angle.sin(), -z], dim=1)
    return (0.7 + 0.6 * drawn[2])[:, None] * directions
