"""The transfer curve of sRGB, undone; ``sfm/photographs.py`` has the way forth."""

import torch
from jaxtyping import Float
from torch import Tensor


def linear_from_srgb(encoded: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Turn sRGB values in [0, 1], as files hold them, into linear radiance.

    Piecewise as IEC 61966-2-1 defines it: a straight piece below 0.04045, a power of 2.4
    above. Differentiable.

    >>> linear_from_srgb(torch.tensor([0.0, 0.5, 1.0]))
    tensor([0.0000, 0.2140, 1.0000])
    """
    curved = ((encoded.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(encoded <= 0.04045, encoded / 12.92, curved)
