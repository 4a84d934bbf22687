"""Photographs and maps of a data set, read from paths."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.io.decode import read_header
from pimper_torch.io.photographs import read_mask, shrunk_focals, shrunk_size
from pimper_torch.io.radiance import read_pictures, resized_mask
from pimper_torch.io.responses import warn_of_responses
from pimper_torch.radiometry import Encoding
from pimper_torch.records import Views
from pimper_torch.runtime.errors import InputError


def read_photographs(
    paths: Sequence[Path],
    names: Sequence[str],
    *,
    encoding: Encoding,
    max_size_px: int = 0,
    masks: Sequence[Path | None] | None = None,
) -> Views:
    """Read photographs as linear radiance, padded to one raster.

    Args:
        names: Unique, one per path.
        encoding: Response, saturation and black level of the files.
        max_size_px: Maximum length of the photographs' longer side; 0 for no limit.
        masks: One per path, of any size: it is scaled to the photograph. Without a mask, a
            photograph shows the object where it is opaque.
    """
    if max_size_px < 0:
        raise InputError(f"max_size_px is {max_size_px}; needed: 0, or the longest side in pixels.")
    headers = [read_header(existing(path)) for path in paths]
    sizes = [shrunk_size(header.width, header.height, max_size_px) for header in headers]
    warn_of_responses(paths[0].parent, paths, headers, encoding)
    images, transparent = read_pictures(paths, headers, sizes, encoding)
    files = [None] * len(paths) if masks is None else masks
    mask_of = {path: _read_mask(path) for path in dict.fromkeys(files) if path is not None}
    inside = torch.zeros(len(paths), *images.shape[-2:], dtype=torch.bool)
    for view, (path, opaque, (wide, high)) in enumerate(
        zip(files, transparent, sizes, strict=True)
    ):
        if path is None and opaque is not None:
            inside[view] = opaque
        else:
            mask = None if path is None else mask_of[path]
            inside[view, :high, :wide] = resized_mask(mask, wide, high)
    has_masks = bool(mask_of) or any(opaque is not None for opaque in transparent)
    return Views(
        images=images,
        sizes_px=torch.tensor(sizes),
        names=tuple(names),
        masks=inside if has_masks else None,
        focals_px=shrunk_focals(headers, sizes),
    )


def nearest(
    values: Shaped[Tensor, "height_in width_in *rest"], width: int, height: int
) -> Shaped[Tensor, "{height} {width} *rest"]:
    """Shrink a map by selecting, for each new pixel, the value at its centre."""
    rows = ((torch.arange(height) + 0.5) * values.shape[0] / height).long()
    columns = ((torch.arange(width) + 0.5) * values.shape[1] / width).long()
    return values[rows[:, None], columns]


def intrinsics_from_indices(intrinsics: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Convert a ``K`` that counts pixel centres from 0 to our convention."""
    moved = intrinsics.clone()
    moved[..., :2, 2] = pixels_from_indices(moved[..., :2, 2])
    return moved


def existing(path: Path) -> Path:
    """Return the path of a required file of a data set, or raise."""
    if not path.is_file():
        raise InputError(
            f"{path}: does not exist, but is part of the data set. Unpack the data "
            "set again, or exclude the positions and lights whose files are missing."
        )
    return path


def _read_mask(path: Path) -> Float[Tensor, "height width"]:
    if not path.is_file():
        raise InputError(f"{path}: does not exist; needed: the mask of a photograph.")
    mask = read_mask(path)
    if not bool(mask.any()):
        raise InputError(
            f"{path}: marks no pixel as object; needed: bright (or opaque) on the object, black "
            "elsewhere. Correct it, or remove the photograph."
        )
    return mask.float()
