"""The inverse of ``slopes_from_normals``."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize


def normals_from_slopes(slopes: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Return the unit normal with ``n_z < 0`` of slopes of the depth."""
    return normalize(torch.cat([slopes, -torch.ones_like(slopes[..., :1])], dim=-1), dim=-1)
