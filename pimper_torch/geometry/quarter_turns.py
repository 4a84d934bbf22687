"""Lenses, poses and pixels of images that are turned by quarters."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.records import CameraModel

QUARTERS = {1: 0, 6: 1, 3: 2, 8: 3}
"""Clockwise quarters by which EXIF's orientations turn a file's pixels; the others also mirror."""

_ONE_FOCAL = ("SIMPLE_", "RADIAL")
# Positions of pairs of parameters that turn as vectors: decentering and thin prisms.
_VECTORS = {
    "OPENCV": ((7, 6),),
    "FULL_OPENCV": ((7, 6),),
    "THIN_PRISM_FISHEYE": ((7, 6), (10, 11)),
    "RAD_TAN_THIN_PRISM_FISHEYE": ((10, 11), (12, 14), (13, 15)),
}


def turned_size(width: int, height: int, quarters: int) -> tuple[int, int]:
    """Return width and height, exchanged for an odd number of quarter turns."""
    return (height, width) if quarters % 2 else (width, height)


def turned_pixels(
    pixels: Float[Tensor, "*batch 2"], width: int, height: int, quarters: int
) -> Float[Tensor, "*batch 2"]:
    """Return the positions of pixels after clockwise quarter turns of their image.

    >>> turned_pixels(torch.tensor([3.0, 1.0]), width=8, height=6, quarters=1)
    tensor([5., 3.])
    """
    for _ in range(quarters % 4):
        pixels = torch.stack([height - pixels[..., 1], pixels[..., 0]], dim=-1)
        width, height = height, width
    return pixels


def turned_pose(
    cam_from_world: Float[Tensor, "*batch 4 4"], quarters: int
) -> Float[Tensor, "*batch 4 4"]:
    """Return the pose of a camera turned with its image; exact."""
    x, y, *rest = cam_from_world.unbind(dim=-2)
    for _ in range(quarters % 4):
        x, y = -y, x
    return torch.stack([x, y, *rest], dim=-2)


def turned_lens(lens: CameraModel, quarters: int) -> CameraModel:
    """Return a lens turned with its image, for all COLMAP models; it images turned directions.

    Quarter turns exchange focal lengths, move the principal point, and turn parameters that are
    vectors in the image: ``p2, p1`` and ``sx1, sy1``.
    """
    size = lens.width, lens.height
    values, focals = list(lens.params), count_focals(lens)
    if focals == 2 and quarters % 2:
        values[0], values[1] = values[1], values[0]
    center = torch.tensor(values[focals : focals + 2], dtype=torch.float64)
    values[focals : focals + 2] = turned_pixels(center, *size, quarters).tolist()
    for first, second in _VECTORS.get(lens.model, ()):
        vector = torch.tensor([values[first], values[second]], dtype=torch.float64)
        values[first], values[second] = turned_pixels(vector, 0, 0, quarters).tolist()
    width, height = turned_size(*size, quarters)
    return lens.replace(params=tuple(values), width=width, height=height)


def count_focals(lens: CameraModel) -> int:
    """Count the focal lengths, which precede the principal point."""
    return 1 if lens.model.startswith(_ONE_FOCAL) else 2
