"""Photographs and maps of a data set, read by path and shrunk by the same factor."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.io.decode import read_header
from pimper_torch.io.photographs import read_mask, shrunk_size
from pimper_torch.io.radiance import read_pictures, resized_mask
from pimper_torch.radiometry import Encoding
from pimper_torch.records import Views


def read_photographs(
    paths: Sequence[Path],
    names: Sequence[str],
    *,
    encoding: Encoding,
    max_size_px: int = 0,
    masks: Sequence[Path] | None = None,
) -> Views:
    """Read photographs of one size as linear radiance.

    Args:
        paths: JPEG, PNG, TIFF, BMP or PGM.
        names: Unique, one a path.
        encoding: Response, saturation and black level of the files.
        max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.
        masks: One a path, brighter than half on the object; a mask that several
            photographs share is decoded once.

    Raises:
        InputError: Names files that are missing, damaged or of another size.
    """
    if max_size_px < 0:
        raise InputError(f"max_size_px is {max_size_px}; needed: 0, or the longest side in pixels.")
    headers = [read_header(there(path)) for path in paths]
    full, channels = (headers[0].width, headers[0].height), headers[0].channels
    for path, header in zip(paths, headers, strict=True):
        _same_size(path, (header.width, header.height), paths[0], full)
        if header.channels != channels:
            raise InputError(
                f"{path}: has {header.channels} colours, but {paths[0].name} has {channels}; "
                "needed: photographs of one kind. Unpack the data set again."
            )
    width, height = shrunk_size(headers[0], max_size_px)
    images = read_pictures(paths, headers, [(width, height)] * len(paths), encoding).images
    return Views(
        images=images,
        sizes_px=torch.tensor([[width, height]]).repeat(len(paths), 1),
        names=tuple(names),
        masks=None if masks is None else _read_masks(masks, width, height, paths[0], full),
        focals_px=torch.full((len(paths),), torch.nan),
    )


def nearest(
    values: Shaped[Tensor, "height_in width_in *rest"], width: int, height: int
) -> Shaped[Tensor, "{height} {width} *rest"]:
    """Shrink a map whose values must not be mixed: each new pixel takes what is at its centre."""
    rows = ((torch.arange(height) + 0.5) * values.shape[0] / height).long()
    columns = ((torch.arange(width) + 0.5) * values.shape[1] / width).long()
    return values[rows[:, None], columns]


def intrinsics_from_indices(
    intrinsics: Float[Tensor, "*batch 3 3"],
) -> Float[Tensor, "*batch 3 3"]:
    """Move the principal point of a ``K`` that counts pixel centres from 0 to our convention."""
    moved = intrinsics.clone()
    moved[..., :2, 2] = pixels_from_indices(moved[..., :2, 2])
    return moved


def _read_masks(
    paths: Sequence[Path], width: int, height: int, photograph: Path, size: tuple[int, int]
) -> Bool[Tensor, "view {height} {width}"]:
    drawn: dict[Path, Tensor] = {}
    for path in paths:
        if path not in drawn:
            mask = read_mask(there(path))
            _same_size(path, (mask.shape[1], mask.shape[0]), photograph, size)
            drawn[path] = resized_mask(mask.float(), width, height)
    return torch.stack([drawn[path] for path in paths])


def there(path: Path) -> Path:
    """Return the path of a file that a data set should hold, or refuse."""
    if not path.is_file():
        raise InputError(
            f"{path}: there is no such file, though the data set should hold it. Unpack the data "
            "set again, or leave out the positions and lights whose files are missing."
        )
    return path


def _same_size(path: Path, size: tuple[int, int], other: Path, expected: tuple[int, int]) -> None:
    if size != expected:
        raise InputError(
            f"{path}: is {size[0]} x {size[1]}, but {other.name} is {expected[0]} x {expected[1]}; "
            "needed: files of one size, as the data set has them. Unpack it again."
        )
