"""Pixel conventions, and the conversions of tensors between them.

Ours is COLMAP's: ``(u, v)`` = (right, down) in pixels, with the centre of the top-left pixel at
(0.5, 0.5), so an image covers ``[0, width] x [0, height]``.

=====================================  ===========================================
convention                             centre of the top-left pixel
=====================================  ===========================================
ours, COLMAP                           (0.5, 0.5)
array index, kornia's warp functions   (0, 0)
grid_sample, ``align_corners=False``   (1/width - 1, 1/height - 1)
=====================================  ===========================================
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.records.shapes import Vectors

Matrices3 = Float[Tensor, "*batch 3 3"]
Pairs = Float[Tensor, "*batch 2"]


def grid_from_pixels(pixels: Pairs, width: int, height: int) -> Pairs:
    """Convert pixels to the coordinates of ``grid_sample(..., align_corners=False)``.

    >>> grid_from_pixels(torch.tensor([0.5, 0.5]), width=4, height=2)
    tensor([-0.7500, -0.5000])
    """
    return 2 * pixels / pixels.new_tensor([width, height]) - 1


def indices_from_pixels(pixels: Pairs) -> Pairs:
    """Convert pixels to array indices, which count from the centre of the top-left pixel."""
    return pixels - 0.5


def pixels_from_indices(indices: Pairs) -> Pairs:
    """Convert array indices to pixels, which count from the corner of the top-left pixel."""
    return indices + 0.5


def homogeneous(pixels: Pairs) -> Vectors:
    """Return the homogeneous coordinates of pixels: append 1; differentiable."""
    return torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=-1)


def pixel_centers(
    width: int, height: int, like: Float[Tensor, "..."]
) -> Float[Tensor, "{height} {width} 2"]:
    """Return the centres of all pixels, with the device and dtype of ``like``."""
    u, v = (torch.arange(side, device=like.device).to(like) + 0.5 for side in (width, height))
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)


def crop_intrinsics(intrinsics: Matrices3, left: float, top: float) -> Matrices3:
    """Return the intrinsics of a crop with its corner at pixel ``(left, top)``."""
    shift = torch.zeros_like(intrinsics)
    shift[..., 0, 2], shift[..., 1, 2] = left, top
    return intrinsics - shift


def scale_intrinsics(intrinsics: Matrices3, factor_u: float, factor_v: float) -> Matrices3:
    """Return the intrinsics of a resized image; its corners stay corners: no half-pixel shift."""
    scale = intrinsics.new_tensor([factor_u, factor_v, 1.0])
    return scale[:, None] * intrinsics
