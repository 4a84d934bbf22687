"""Translations between images by phase correlation of their texture."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.records.shapes import Map


def shift_between(texture: Map, other: Map) -> tuple[Float[Tensor, "2"], Float[Tensor, ""]]:
    """Estimate the integer shift in pixels between two textures.

    Args:
        texture: Mean zero, 0 where unknown; the same holds for ``other``.

    Returns:
        The shift to add to ``(u, v)``, pixels, and the correlation over the pixels known in both; 0
        if these are less than a tenth of the raster. Not differentiable.

    Source: of the peak, Kuglin & Hines, The phase correlation image alignment method, 1975.
    """
    height, width = texture.shape
    spectrum = torch.fft.rfft2(texture).conj() * torch.fft.rfft2(other)
    spectrum = spectrum / spectrum.abs().clamp_min(1e-12)
    peak = int(torch.fft.irfft2(spectrum, s=(height, width)).argmax())
    down, across = peak // width, peak % width
    down, across = (
        shift - size if shift > size // 2 else shift
        for shift, size in ((down, height), (across, width))
    )
    rows = slice(max(0, -down), height - max(0, down)), slice(max(0, down), height + min(0, down))
    columns = (
        slice(max(0, -across), width - max(0, across)),
        slice(max(0, across), width + min(0, across)),
    )
    a, b = texture[rows[0], columns[0]], other[rows[1], columns[1]]
    known = (a != 0) & (b != 0)
    product, square_a, square_b = (values[known].sum() for values in (a * b, a * a, b * b))
    correlation = product / (square_a * square_b).sqrt().clamp_min(1e-12)
    enough = known.sum() >= 0.1 * texture.numel()
    return texture.new_tensor([across, down]), torch.where(enough, correlation, 0)
