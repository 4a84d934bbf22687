"""Translations between photographs by the correlation of their texture."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.shapes import Map


def shift_between(texture: Map, other: Map) -> tuple[Float[Tensor, "2"], Float[Tensor, ""]]:
    """Find the whole pixels that bring one photograph's texture onto another's.

    Args:
        texture: Mean zero, 0 where nothing is known; and of ``other``.

    Returns:
        The shift to add to ``(u, v)``, pixels, and the correlation of the overlap's known pixels; 0
        where these are less than a tenth of the raster. A constant to autograd.

    Source: of the peak, Kuglin & Hines, The phase correlation image alignment method, 1975.
    """
    height, width = texture.shape
    spectrum = torch.fft.rfft2(texture).conj() * torch.fft.rfft2(other)
    spectrum = spectrum / spectrum.abs().clamp_min(1e-12)
    peak = int(torch.fft.irfft2(spectrum, s=(height, width)).argmax())
    down, across = peak // width, peak % width
    down, across = (
        at - size if at > size // 2 else at for at, size in ((down, height), (across, width))
    )
    rows = slice(max(0, -down), height - max(0, down)), slice(max(0, down), height + min(0, down))
    columns = (
        slice(max(0, -across), width - max(0, across)),
        slice(max(0, across), width + min(0, across)),
    )
    here, there = texture[rows[0], columns[0]], other[rows[1], columns[1]]
    known = (here != 0) & (there != 0)
    product, own, others = (
        (a * b)[known].sum() for a, b in ((here, there), (here, here), (there, there))
    )
    correlation = product / (own * others).sqrt().clamp_min(1e-12)
    enough = known.sum() >= 0.1 * texture.numel()
    return texture.new_tensor([across, down]), torch.where(enough, correlation, 0)
