"""Photographs at several sizes, looked up at the one that suits a sample's footprint."""

import torch
from jaxtyping import Float
from kornia.geometry.transform import pyrdown, remap
from torch import Tensor
from torch.nn.functional import conv2d, pad

from pimper_torch.geometry.pixels import grid_from_pixels


def halve(images: Float[Tensor, "view channels _ _"]) -> Float[Tensor, "view channels _ _"]:
    """Blur and halve images as kornia's ``pyrdown`` does, in a sixth of the time.

    Burt's binomial of five, then the mean of two: together six taps along rows and along
    columns, at every other pixel. Sides that are odd go by ``pyrdown`` itself.
    """
    height, width = images.shape[-2:]
    if height % 2 or width % 2:
        return pyrdown(images)
    taps = images.new_tensor([1, 5, 10, 10, 5, 1]) / 32
    planes = pad(images.reshape(-1, 1, height, width), (2, 2, 2, 2), mode="reflect")
    planes = conv2d(planes, taps.reshape(1, 1, 1, 6), stride=(1, 2))
    planes = conv2d(planes, taps.reshape(1, 1, 6, 1), stride=(2, 1))
    return planes.reshape(*images.shape[:-2], height // 2, width // 2)


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


def look_up(
    pyramid: list[Float[Tensor, "channels _ _"]],
    pixels: Float[Tensor, "sample 2"],
    level: Float[Tensor, " sample"],
) -> Float[Tensor, "sample channels"]:
    """Look an image up, blending the two pyramid levels next to each sample's own.

    Every level covers the same ``[0, width] x [0, height]`` of the finest, so one
    normalised grid serves all. Differentiable in images and pixels.
    """
    finest = pyramid[0]
    grid = grid_from_pixels(pixels, width=finest.shape[-1], height=finest.shape[-2])
    grid = grid.clamp(-3, 3).to(finest)
    level = level.clamp(0, len(pyramid) - 1).to(finest)
    total = finest.new_zeros(len(grid), len(finest))
    for index, image in enumerate(pyramid):
        weight = (1 - (level - index).abs()).clamp_min(0)
        (some,) = torch.nonzero(weight > 0, as_tuple=True)
        if len(some) > 0:
            blended = weight[some, None] * _bilinear(image, grid[some])
            total = total.index_add(0, some, blended)
    return total


def _bilinear(
    image: Float[Tensor, "channels _ _"], grid: Float[Tensor, "sample 2"]
) -> Float[Tensor, "sample channels"]:
    """Look up in as many batches as there are threads: each is one thread's on the CPU."""
    threads = torch.get_num_threads()
    filled = pad(grid, (0, 0, 0, -len(grid) % threads)).reshape(threads, -1, 1, 2)
    found = remap(
        image.expand(threads, -1, -1, -1),
        filled[..., 0],
        filled[..., 1],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
        normalized_coordinates=True,
    )
    return found[..., 0].transpose(1, 2).reshape(-1, len(image))[: len(grid)]


def _difference(
    values: Float[Tensor, "patch height width 2"], dim: int
) -> Float[Tensor, "patch height width 2"]:
    """Take forward differences, the last one repeated; zero along a single sample."""
    steps = values.diff(dim=dim)
    if steps.shape[dim] == 0:
        return torch.zeros_like(values)
    return torch.cat([steps, steps.narrow(dim, steps.shape[dim] - 1, 1)], dim=dim)
