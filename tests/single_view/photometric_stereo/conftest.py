from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize


@dataclass
class Scene:
    """A closed form: normals and mask of a raster, camera frame."""

    normals: Tensor  # height width 3
    mask: Tensor

    @property
    def columns(self) -> Tensor:
        return self.normals[self.mask].mT

    def raster(self, samples: Tensor) -> Tensor:
        """Put samples (view pixel) on the raster as images of one channel."""
        images = samples.new_zeros(len(samples), 1, *self.mask.shape)
        images[:, 0, self.mask] = samples
        return images


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(1994)


@pytest.fixture
def bumpy() -> Scene:
    """A bowl with waves, bulging towards the viewer, without any symmetry."""
    side = torch.linspace(-1, 1, 56, dtype=torch.float64)
    y, x = torch.meshgrid(side, side, indexing="ij")
    first, second = torch.cos(4 * x + 1.5 * y), torch.sin(5 * y - 2 * x)
    slope_x = 0.9 * x + 0.6 * first + 0.2 * second
    slope_y = 0.7 * y + 0.225 * first - 0.5 * second
    normals = normalize(torch.stack([slope_x, slope_y, -torch.ones_like(x)], dim=-1), dim=-1)
    mask = torch.ones_like(x, dtype=torch.bool)
    mask[:4, :7] = False
    mask[20:23, 30:35] = False  # a hole
    return Scene(normals=normals, mask=mask)


@pytest.fixture
def ball() -> Scene:
    side = torch.linspace(-1.05, 1.05, 60, dtype=torch.float64)
    y, x = torch.meshgrid(side, side, indexing="ij")
    square = x**2 + y**2
    normals = torch.stack([x, y, -(1 - square).clamp_min(0).sqrt()], dim=-1)
    return Scene(normals=normals, mask=square < 0.97**2)


@pytest.fixture
def point_lights(generator: torch.Generator) -> Callable[..., Tensor]:
    """Point lights of strength one, on the viewer's side."""

    def make(views: int, spread: float = 0.6) -> Tensor:
        sideways = 2 * torch.rand(views, 2, generator=generator, dtype=torch.float64) - 1
        ahead = -torch.ones_like(sideways[:, :1])
        return normalize(torch.cat([spread * sideways, ahead], dim=1), dim=1)

    return make


@pytest.fixture
def patchwork() -> Callable[[Scene], Tensor]:
    """Albedos of two values with sharp edges."""

    def make(scene: Scene) -> Tensor:
        height, width = scene.mask.shape
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        return torch.where((x // 9 + y // 7) % 2 == 0, 0.8, 0.35).double()[scene.mask]

    return make


@pytest.fixture
def angles_deg() -> Callable[[Tensor, Tensor], Tensor]:
    """Angles between columns, by the chord, which float64 resolves near zero."""

    def measure(found: Tensor, true: Tensor) -> Tensor:
        chord = (normalize(found, dim=0) - normalize(true, dim=0)).norm(dim=0)
        return torch.rad2deg(2 * torch.asin((chord / 2).clamp_max(1)))

    return measure
