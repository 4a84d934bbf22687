r"""From slopes to heights on batches of small rasters.

All of it is the least-squares problem :math:`\min_z \sum |\nabla z - g|^2` with forward
differences and nothing fixed at the border. The cosine basis (the Fourier basis of the mirrored
raster) turns it into a division, frequency by frequency.

The transforms are products with the basis: on rasters of 30 to 120 samples a side, the size
of templates, they are 3 to 10 times faster than FFTs, and at 500 still within a factor 1.6.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def cosine_basis(size: int, like: Float[Tensor, "..."]) -> Float[Tensor, "{size} {size}"]:
    """Return the orthonormal cosines (DCT-II), one a row, with device and dtype of ``like``."""
    frequency = torch.arange(size, device=like.device, dtype=like.dtype)
    basis = (math.pi / size * frequency[:, None] * (frequency + 0.5)).cos()
    basis = basis * math.sqrt(2 / size)
    return torch.cat([basis[:1] * math.sqrt(0.5), basis[1:]])


def differences(
    heights: Float[Tensor, "*batch height width"],
) -> tuple[Float[Tensor, "*batch height steps_right"], Float[Tensor, "*batch steps_down width"]]:
    """Return the steps to the right and down."""
    return heights.diff(dim=-1), heights.diff(dim=-2)


def differences_transposed(
    right: Float[Tensor, "*batch height steps_right"],
    down: Float[Tensor, "*batch steps_down width"],
) -> Float[Tensor, "*batch height width"]:
    """Apply the transpose of :func:`differences`: minus the divergence."""
    pad = torch.nn.functional.pad
    across = pad(right, (1, 0)) - pad(right, (0, 1))
    return across + pad(down, (0, 0, 1, 0)) - pad(down, (0, 0, 0, 1))


def solve_poisson(
    source: Float[Tensor, "*batch height width"],
    weight_right: float = 1.0,
    weight_down: float = 1.0,
    anchor: float = 0.0,
) -> Float[Tensor, "*batch height width"]:
    r"""Solve :math:`(D^T W D + a) z = s`, D the steps of :func:`differences`.

    Args:
        source: ``s``. Without anchor no ``z`` can produce its mean, which is ignored; ``z``
            then has mean zero.
        anchor: ``a`` of all samples, not negative.

    Differentiable in ``source``.
    """
    height, width = source.shape[-2:]
    rows, cols = cosine_basis(height, source), cosine_basis(width, source)
    across = weight_down * _stiffness(height, source)[:, None]
    stiffness = across + weight_right * _stiffness(width, source) + anchor
    # No height answers to the mean; dividing it by infinity removes it.
    stiffness = stiffness.masked_fill(stiffness == 0, torch.inf)
    return rows.mT @ ((rows @ source @ cols.mT) / stiffness) @ cols


def integrate_steps(
    right: Float[Tensor, "*batch height steps_right"],
    down: Float[Tensor, "*batch steps_down width"],
) -> Float[Tensor, "*batch height width"]:
    """Find the heights, of mean zero, whose steps come nearest to those given.

    Steps that belong to a height field give it back exactly, a tilted plane included: the
    basis does not force the borders to meet, as that of the periodic raster would.

    Source: Frankot & Chellappa, PAMI 10(4), 1988, in the cosine basis; Simchony, Chellappa &
    Shao, PAMI 12(5), 1990, for the discrete operator.
    """
    return solve_poisson(differences_transposed(right, down))


def _stiffness(size: int, like: Float[Tensor, "..."]) -> Float[Tensor, " {size}"]:
    frequency = torch.arange(size, device=like.device, dtype=like.dtype)
    return 4 * (math.pi / (2 * size) * frequency).sin() ** 2
