"""The curve of IEC 61966-2-1, sRGB."""

import torch
from jaxtyping import Float, UInt8
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


def srgb_from_linear(radiance: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Encode linear radiance in [0, 1] with the sRGB curve; undoes :func:`linear_from_srgb`."""
    light = radiance.clamp(0, 1)
    return torch.where(
        light <= 0.0031308, 12.92 * light, 1.055 * light.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    )


def to_bytes(radiance: Float[Tensor, "*batch"]) -> UInt8[Tensor, "*batch"]:
    """Encode linear radiance as 8-bit sRGB."""
    return (255 * srgb_from_linear(radiance)).round().to(torch.uint8)
