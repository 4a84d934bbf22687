"""Directions spread over the sphere, and over hemispheres."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
_GOLDEN_RATIO = (math.sqrt(5) - 1) / 2


def even_directions(count: int) -> Float[Tensor, "direction 3"]:
    """Spread unit directions evenly over the sphere, along a Fibonacci spiral; float64."""
    step = torch.arange(count, dtype=torch.float64)
    height = 1 - (2 * step + 1) / count
    radius = (1 - height**2).sqrt()
    rotation = _GOLDEN_ANGLE * step
    return torch.stack([radius * rotation.cos(), radius * rotation.sin(), height], dim=1)


def cosine_fan(
    normals: Float[Tensor, "normal 3"], rotations: Float[Tensor, " normal"], num_rays: int
) -> Float[Tensor, "normal ray 3"]:
    """Spread rays round normals as densely as a matte surface weighs light.

    Args:
        rotations: Of each fan about its normal, in radians: neighbours' fans then differ.
    """
    step = torch.arange(num_rays)
    across = ((step + 0.5) / num_rays).sqrt()  # even over the disc below the hemisphere
    angle = 2 * torch.pi * torch.remainder(step * _GOLDEN_RATIO, 1) + rotations[:, None]
    # Duff et al., JCGT 6(1), 2017: a frame round each normal, without a branch.
    x, y, z = normals.unbind(dim=-1)
    sign = torch.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=-1)
    second = torch.stack([b, sign + y * y * a, -y], dim=-1)
    fan = (
        (across * angle.cos())[..., None] * first[:, None]
        + (across * angle.sin())[..., None] * second[:, None]
        + ((1 - across**2).sqrt()[:, None]) * normals[:, None]
    )
    return normalize(fan, dim=-1)
