r"""Integration of slopes on a rectangle in the Fourier basis, by Frankot and Chellappa.

.. math:: \hat z = \frac{-i\omega_x \hat p - i\omega_y \hat q}{\omega_x^2 + \omega_y^2}

is the projection of ``p, q`` on integrable slopes. The basis is periodic, which surfaces are
not: the rectangle is mirrored in both directions, heights evenly, so that they are continuous
across every border, and the mean slope is subtracted before and added after.

Source: Frankot & Chellappa, A method for enforcing integrability in shape from shading
algorithms, PAMI 10(4), 1988.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def integrate_fourier(
    slope_right: Float[Tensor, "*batch height width"],
    slope_down: Float[Tensor, "*batch height width"],
    pixel_width: float = 1.0,
    pixel_height: float = 1.0,
) -> Float[Tensor, "*batch height width"]:
    """Return the heights, of mean zero, whose slopes are nearest to those given.

    Args:
        pixel_width: Distance of neighbouring pixels in a row.
        pixel_height: Distance of rows.

    Differentiable.
    """
    height, width = slope_right.shape[-2:]
    means = [slope.mean(dim=(-2, -1), keepdim=True) for slope in (slope_right, slope_down)]
    right = _mirrored(slope_right - means[0], odd=-1, even=-2)
    down = _mirrored(slope_down - means[1], odd=-2, even=-1)
    across = _frequencies(2 * width, pixel_width, slope_right)
    along = _frequencies(2 * height, pixel_height, slope_right)[:, None]
    square = across.square() + along.square()
    spectrum = -1j * (across * torch.fft.fft2(right) + along * torch.fft.fft2(down))
    # The mean is removed by division by infinity.
    spectrum = spectrum / square.masked_fill(square == 0, torch.inf)
    waves = torch.fft.ifft2(spectrum).real[..., :height, :width]
    column = torch.arange(width, device=waves.device, dtype=waves.dtype) - (width - 1) / 2
    row = torch.arange(height, device=waves.device, dtype=waves.dtype) - (height - 1) / 2
    plane = means[0] * pixel_width * column + means[1] * pixel_height * row[:, None]
    return plane + waves - waves.mean(dim=(-2, -1), keepdim=True)


def _mirrored(raster: Float[Tensor, "*batch height width"], odd: int, even: int) -> Tensor:
    """Extend slopes as those of a mirrored height: negated along their own direction."""
    raster = torch.cat([raster, raster.flip(even)], dim=even)
    return torch.cat([raster, -raster.flip(odd)], dim=odd)


def _frequencies(size: int, spacing: float, like: Float[Tensor, "..."]) -> Float[Tensor, " {size}"]:
    frequencies = torch.fft.fftfreq(size, device=like.device, dtype=like.dtype)
    # The Nyquist frequency has no sign, and so no slope.
    frequencies[size // 2] = 0
    return 2 * torch.pi / spacing * frequencies
