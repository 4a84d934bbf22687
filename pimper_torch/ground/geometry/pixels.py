"""Every pixel convention, and the only conversions between them.

Ours is COLMAP's: ``(u, v)`` = (right, down) in pixels, and the centre of the top-left pixel
is (0.5, 0.5), so that an image covers ``[0, width] x [0, height]``.

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

from pimper_torch.ground.shapes import Vectors

Matrices3 = Float[Tensor, "*batch 3 3"]
Pairs = Float[Tensor, "*batch 2"]


def grid_from_pixels(pixels: Pairs, width: int, height: int) -> Pairs:
    """Turn pixels into the coordinates ``grid_sample(..., align_corners=False)`` expects.

    >>> grid_from_pixels(torch.tensor([0.5, 0.5]), width=4, height=2)
    tensor([-0.7500, -0.5000])
    """
    return 2 * pixels / pixels.new_tensor([width, height]) - 1


def indices_from_pixels(pixels: Pairs) -> Pairs:
    """Count from the centre of the top-left pixel instead of its corner."""
    return pixels - 0.5


def pixels_from_indices(indices: Pairs) -> Pairs:
    """Count from the corner of the top-left pixel instead of its centre."""
    return indices + 0.5


def homogeneous(pixels: Pairs) -> Vectors:
    """Append 1 to pixels, as homographies and epipolar geometries take them; differentiable."""
    return torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=-1)


def pixel_centers(
    width: int, height: int, like: Float[Tensor, "..."]
) -> Float[Tensor, "{height} {width} 2"]:
    """List the centres of all pixels, with the device and dtype of ``like``."""
    u = torch.arange(width, device=like.device, dtype=like.dtype) + 0.5
    v = torch.arange(height, device=like.device, dtype=like.dtype) + 0.5
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)


def crop_intrinsics(intrinsics: Matrices3, left: float, top: float) -> Matrices3:
    """Follow a cut of the image: pixels count from its corner, ``(left, top)`` of before."""
    moved = torch.zeros_like(intrinsics)
    moved[..., 0, 2], moved[..., 1, 2] = left, top
    return intrinsics - moved


def scale_intrinsics(intrinsics: Matrices3, factor_u: float, factor_v: float) -> Matrices3:
    """Follow a resize of the image; corners stay corners, so no half-pixel shift arises."""
    scale = intrinsics.new_tensor([factor_u, factor_v, 1.0])
    return scale[:, None] * intrinsics
