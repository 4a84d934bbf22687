"""Closed-form surfaces from one viewpoint, in the camera frame."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize


@dataclass
class Scene:
    """Normals and mask of a raster."""

    normals: Tensor  # height width 3
    mask: Tensor

    @property
    def columns(self) -> Tensor:
        return self.normals[self.mask].mT

    @property
    def even(self) -> Tensor:
        """Weights of 1."""
        return torch.ones_like(self.columns[0])

    @property
    def patchwork(self) -> Tensor:
        """Albedos of two values with sharp edges."""
        y, x = self.mask.nonzero(as_tuple=True)
        return torch.where((x // 9 + y // 7) % 2 == 0, 0.8, 0.35).double()

    def raster(self, samples: Tensor) -> Tensor:
        """Return samples (view pixel) as single-channel images on the raster."""
        images = samples.new_zeros(len(samples), 1, *self.mask.shape)
        images[:, 0, self.mask] = samples
        return images


def square(side):
    y, x = torch.meshgrid(side, side, indexing="ij")
    return x, y


def bumpy() -> Scene:
    """Return a wavy bowl, convex towards the viewer, without symmetry."""
    x, y = square(torch.linspace(-1, 1, 56, dtype=torch.float64))
    first, second = torch.cos(4 * x + 1.5 * y), torch.sin(5 * y - 2 * x)
    slope_x = 0.9 * x + 0.6 * first + 0.2 * second
    slope_y = 0.7 * y + 0.225 * first - 0.5 * second
    normals = normalize(torch.stack([slope_x, slope_y, -torch.ones_like(x)], dim=-1), dim=-1)
    mask = torch.ones_like(x, dtype=torch.bool)
    mask[:4, :7] = False
    mask[20:23, 30:35] = False  # a hole
    return Scene(normals=normals, mask=mask)


def ball() -> Scene:
    x, y = square(torch.linspace(-1.05, 1.05, 60, dtype=torch.float64))
    radius = x**2 + y**2
    normals = torch.stack([x, y, -(1 - radius).clamp_min(0).sqrt()], dim=-1)
    return Scene(normals=normals, mask=radius < 0.97**2)


BUMPY, BALL = bumpy(), ball()


def strong_lights(generator, views: int, spread: float = 0.6) -> Tensor:
    """Return point lights of unit strength on the viewer's side."""
    sideways = 2 * torch.rand(views, 2, generator=generator, dtype=torch.float64) - 1
    ahead = -torch.ones_like(sideways[:, :1])
    return normalize(torch.cat([spread * sideways, ahead], dim=1), dim=1)


def angles_deg(found: Tensor, true: Tensor) -> Tensor:
    """Return angles between columns by the chord, which is accurate near zero."""
    chord = (normalize(found, dim=0) - normalize(true, dim=0)).norm(dim=0)
    return torch.rad2deg(2 * torch.asin((chord / 2).clamp_max(1)))
