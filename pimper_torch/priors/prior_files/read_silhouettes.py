"""Silhouettes of a segmenter, and pixels that a person points at."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from pimper_torch.doors.scale.given import Mark, number_of, require_inside
from pimper_torch.priors.from_maps import silhouettes_from, stacked
from pimper_torch.priors.prior_files.folder import read_maps, single
from pimper_torch.priors.prior_files.map_file import Layer
from pimper_torch.records import SilhouettePrior, Views
from pimper_torch.runtime.errors import InputError

_KINDS = ("mask", "silhouette", "alpha", "inside")  # how names of arrays begin


def read_silhouettes(
    folder: Path | str, views: Views, *, undistorted: bool = False
) -> SilhouettePrior:
    """Read soft masks of photographs from a folder: PNG or JPEG of 8 or 16 bits, EXR, NPZ or NPY.

    A mask has the photograph's name, with words that segmenters append, its shape, and any size;
    some photographs may have none. It is 1 on the object, in full scale. The mask of a picture that
    is somewhere transparent is its opacity. NaN is unknown.

    Args:
        undistorted: Whether they are of the photographs as a run undistorts them.
    """
    maps = read_maps(folder, views, _KINDS, _chance, undistorted=undistorted, cut_out=True)
    return silhouettes_from(maps)


def _chance(path: Path, layer: Layer) -> np.ndarray:
    values = single(path, layer)
    known = values[np.isfinite(values)]
    if layer.labelled:  # all but 0 is the object
        return (values > 0).astype(np.float32)
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    if low < 0 or high > 1:
        levels = low >= 0 and high in (255, 65535)
        advice = (
            f"Divide these levels by {high:g}, or write them as whole numbers."
            if levels
            else "A network's logits go through a sigmoid first."
        )
        raise InputError(
            f"{path}: holds values from {low:g} to {high:g}; needed: the probability of the "
            f"object, from 0 to 1. {advice}"
        )
    return values


def object_at(marks: Sequence[Mark], views: Views) -> SilhouettePrior:
    """Make maps of pixels that show the object; all other pixels are unknown.

    Args:
        marks: Places on it, in one photograph or more each.

    Raises:
        InputError: No such photograph, or a pixel outside of it.
    """
    maps: dict[int, torch.Tensor] = {}
    for pointer in (one for mark in marks for one in mark.pointers):
        view = number_of(pointer.name, views.names)
        size = views.sizes_px[view].tolist()
        full = pointer.size_px or size
        require_inside(pointer, *full)
        scale = min(1.0, 512 / max(size))
        width, height = (max(1, round(scale * side)) for side in size)
        inside = maps.setdefault(view, torch.full((height, width, 1), 0.5))
        column = min(int(pointer.x * width / full[0]), width - 1)
        row = min(int(pointer.y * height / full[1]), height - 1)
        inside[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2] = 1
    return silhouettes_from(stacked({views.names[view]: (one, None) for view, one in maps.items()}))
