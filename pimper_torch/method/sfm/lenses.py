"""Lenses: groups of photographs with a common lens, and lenses of turned images."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.records import CameraModel, Views
from pimper_torch.runtime.errors import InputError, some

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


def group_lenses(sizes: Sequence[tuple[int, int]], focals_px: Sequence[float]) -> list[int]:
    """Group photographs by size and focal length.

    Photographs without a focal length have the lens of their size if it is the only one, and
    otherwise share a separate lens.

    Args:
        focals_px: Focal length of each; NaN if unknown.

    Returns:
        The group of each, numbered in the order of their first photographs.

    >>> group_lenses([(9, 6), (9, 6), (6, 9)], [10.0, 10.1, 10.0])
    [0, 0, 1]
    """
    starts_of: dict[tuple[int, int], list[float]] = {}
    pairs = [pair for pair in zip(focals_px, sizes, strict=True) if not math.isnan(pair[0])]
    for focal, size in sorted(pairs):
        starts = starts_of.setdefault(size, [])  # EXIF rounds by less than 2 %
        if not (starts and focal <= 1.02 * starts[-1]):
            starts.append(focal)
    numbers: dict[tuple[object, ...], int] = {}
    groups = []
    for focal, size in zip(focals_px, sizes, strict=True):
        starts = starts_of.get(size, [])
        if math.isnan(focal):
            lens: object = 0 if len(starts) == 1 else None
        else:
            lens = sum(start <= focal for start in starts) - 1
        groups.append(numbers.setdefault((size, lens), len(numbers)))
    return groups


def choose_lenses(views: Views, *, shared: bool = False, own: bool = False) -> list[int]:
    """Return the number of the lens of each photograph."""
    if own:
        return list(range(views.num_views))
    sizes = [(width, height) for width, height in views.sizes_px.tolist()]
    if not shared:
        return group_lenses(sizes, views.focals_px.tolist())
    groups = {
        size: [name for name, s in zip(views.names, sizes, strict=True) if s == size]
        for size in dict.fromkeys(sizes)
    }
    if len(groups) > 1:
        listed = "; ".join(
            f"{width}x{height}: {some(names)}" for (width, height), names in groups.items()
        )
        raise InputError(
            f"One shared camera was requested, but the photographs have {len(groups)} sizes "
            f"({listed}). Omit `--reconstruct.shared-camera` (`shared_camera: true` in YAML) to "
            "distinguish lenses by size and EXIF, or give photographs of one size."
        )
    return [0] * views.num_views
