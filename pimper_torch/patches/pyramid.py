"""Photographs at several sizes, looked up at the one that suits a sample's footprint."""

import torch
from jaxtyping import Float
from kornia.geometry.transform import pyrdown, remap
from torch import Tensor

from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.records import Views


def image_pyramid(
    views: Views, saturation_level: float, levels: int
) -> list[Float[Tensor, "view channels _ _"]]:
    """Halve the images again and again; the last channel is 1 where a pixel is unusable.

    Unusable is what lies outside the undistorted frame or the mask, is not finite, or is
    saturated in any channel.
    """
    usable = views.inside
    if views.masks is not None:
        usable = usable & views.masks
    finite = views.images.isfinite()
    usable = usable & finite.all(dim=1)
    usable = usable & (views.images.amax(dim=1) < saturation_level)
    # NaN times a weight of 0 is NaN: zeros, which are marked, spread nothing.
    images = torch.where(finite, views.images, 0)
    pyramid = [torch.cat([images, (~usable)[:, None].to(images)], dim=1)]
    while len(pyramid) < levels and min(pyramid[-1].shape[-2:]) >= 8:
        pyramid.append(pyrdown(pyramid[-1]))
    return pyramid


def pyramid_level(
    pixels: Float[Tensor, "patch height width 2"],
) -> Float[Tensor, "patch height width"]:
    """Choose the pyramid level at which neighbouring samples are a pixel apart.

    The footprint is the square root of the area of a sample's parallelogram in the image:
    a compromise for oblique facets between blur along one axis and aliasing along the other.
    """
    du = _difference(pixels, dim=2)
    dv = _difference(pixels, dim=1)
    area = (du[..., 0] * dv[..., 1] - du[..., 1] * dv[..., 0]).abs()
    return 0.5 * area.clamp_min(1).log2()


def sample_pyramid(
    pyramid: list[Float[Tensor, "channels _ _"]],
    pixels: Float[Tensor, "patch height width 2"],
    level: Float[Tensor, "patch height width"],
) -> Float[Tensor, "patch channels height width"]:
    """Look an image up, blending the two pyramid levels next to each sample's own.

    Every level covers the same ``[0, width] x [0, height]`` of the finest, so one
    normalised grid serves all.
    """
    num, rows, columns = level.shape
    grid = grid_from_pixels(pixels, width=pyramid[0].shape[-1], height=pyramid[0].shape[-2])
    grid = grid.reshape(1, num * rows, columns, 2).clamp(-3, 3).to(pyramid[0])
    level = level.clamp(0, len(pyramid) - 1).to(pyramid[0])
    total = pyramid[0].new_zeros(num, pyramid[0].shape[0], rows, columns)
    for index, image in enumerate(pyramid):
        weight = (1 - (level - index).abs()).clamp_min(0)
        if not (weight > 0).any():
            continue
        sampled = remap(
            image[None],
            grid[..., 0],
            grid[..., 1],
            mode="bilinear",
            padding_mode="border",
            align_corners=False,
            normalized_coordinates=True,
        )
        sampled = sampled.reshape(-1, num, rows, columns).transpose(0, 1)
        total = total + weight[:, None] * sampled
    return total


def _difference(
    values: Float[Tensor, "patch height width 2"], dim: int
) -> Float[Tensor, "patch height width 2"]:
    """Take forward differences, the last one repeated; zero along a single sample."""
    steps = values.diff(dim=dim)
    if steps.shape[dim] == 0:
        return torch.zeros_like(values)
    return torch.cat([steps, steps.narrow(dim, steps.shape[dim] - 1, 1)], dim=dim)
