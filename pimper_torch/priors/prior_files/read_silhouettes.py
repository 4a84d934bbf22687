"""Silhouettes of a segmentation network, and pixels marked by the user."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from pimper_torch.priors.from_maps import padded, silhouettes_from
from pimper_torch.priors.prior_files.folder import read_maps, single_channel
from pimper_torch.priors.prior_files.map_file import Layer
from pimper_torch.records import SilhouettePrior, Views
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.file_names import view_named
from pimper_torch.scale.given import Mark, require_inside

_KINDS = ("mask", "silhouette", "alpha", "inside")  # prefixes of the names of arrays


def read_silhouettes(
    folder: Path | str, views: Views, *, undistorted: bool = False
) -> SilhouettePrior:
    """Read soft masks of photographs from a folder: PNG or JPEG of 8 or 16 bits, EXR, NPZ or NPY.

    A mask has the name of its photograph, with words that networks append, its aspect ratio, and
    any size; photographs may lack a mask. It is 1, or full scale, on the object. The mask of an
    image with transparent pixels is its opacity. NaN is unknown.

    Args:
        undistorted: Whether the masks are for photographs undistorted as a run undistorts them.
    """
    maps = read_maps(folder, views, _KINDS, _probability, undistorted=undistorted, cut_out=True)
    return silhouettes_from(maps)


def _probability(path: Path, layer: Layer) -> np.ndarray:
    values = single_channel(path, layer)
    finite = values[np.isfinite(values)]
    if layer.labelled:  # labels other than 0 are the object
        return (values > 0).astype(np.float32)
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    if low < 0 or high > 1:
        advice = "Apply a sigmoid to the logits of a network."
        if low >= 0 and high in (255, 65535):
            advice = f"Divide the values by {high:g}, or write them as integers."
        raise InputError(
            f"{path}: contains values from {low:g} to {high:g}; needed: the probability of the "
            f"object, from 0 to 1. {advice}"
        )
    return values


def object_at(marks: Sequence[Mark], views: Views) -> SilhouettePrior:
    """Return silhouettes that are 1 around marked pixels and unknown elsewhere.

    Args:
        marks: Points on the object, each marked in one or more photographs.

    Raises:
        InputError: A photograph does not exist, or a pixel is outside it.
    """
    maps: dict[int, torch.Tensor] = {}
    for pointer in (pointer for mark in marks for pointer in mark.pointers):
        view = view_named(pointer.name, views.names)
        size = views.sizes_px[view].tolist()
        full = pointer.size_px or size
        require_inside(pointer, *full)
        scale = min(1.0, 512 / max(size))
        width, height = (max(1, round(scale * side)) for side in size)
        unknown = np.full((height, width, 1), 0.5, np.float32)
        inside = maps.setdefault(view, torch.from_numpy(unknown))
        column = min(int(pointer.x * width / full[0]), width - 1)
        row = min(int(pointer.y * height / full[1]), height - 1)
        inside[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2] = 1
    return silhouettes_from(padded({views.names[view]: (m, None) for view, m in maps.items()}))
