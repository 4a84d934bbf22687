"""Unit directions distributed over the sphere."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def even_directions(count: int) -> Float[Tensor, "direction 3"]:
    """Return unit directions evenly distributed on the sphere, by a Fibonacci spiral; float64."""
    step = torch.arange(count, dtype=torch.float64)
    height = 1 - (2 * step + 1) / count
    radius = (1 - height**2).sqrt()
    rotation = _GOLDEN_ANGLE * step
    return torch.stack([radius * rotation.cos(), radius * rotation.sin(), height], dim=1)
