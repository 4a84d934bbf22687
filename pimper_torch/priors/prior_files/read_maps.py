"""Depth and normals of an estimator."""

from collections import Counter
from pathlib import Path
from typing import Literal

import numpy as np

from pimper_torch.doors.io.decode import LABELS
from pimper_torch.priors import from_maps
from pimper_torch.priors.map_config import DEPTH_ERROR, NORMALS_ERROR_DEG, NormalAxes
from pimper_torch.priors.prior_files.folder import read_maps, single
from pimper_torch.priors.prior_files.map_file import Layer
from pimper_torch.records import DepthPrior, NormalPrior, Views
from pimper_torch.runtime.errors import InputError, caution, some


def read_normals(
    folder: Path | str,
    views: Views,
    axes: NormalAxes = "auto",
    *,
    error_deg: float = NORMALS_ERROR_DEG,
    undistorted: bool = False,
) -> NormalPrior:
    """Read normals of photographs from a folder: PNG of 8 or 16 bits, EXR, NPZ or NPY.

    A map has the photograph's name, with words that estimators append, its shape, and any size. PNG
    and arrays without a negative value hold ``(n + 1) / 2``. Vectors far from unit length, and NaN,
    are unknown. ``NAME_variance.npy``, or ``variance`` in NPZ and EXR, has the mean square of the
    angular error in squared radians.

    Args:
        axes: Of the normals: ``opencv`` (Metric3D, Omnidata, MoGe's arrays), ``opengl`` (Marigold,
            MoGe's PNG, DiLiGenT), ``lub`` or ``dsine`` (DSINE, StableNormal, GeoWizard, Lotus),
            ``world`` of the cameras that are given; ``auto`` finds them by the scene.
        error_deg: Root mean square of the angular error, where no file has a variance.
        undistorted: Whether they are of the photographs as a run undistorts them.
    """
    maps = read_maps(folder, views, ("normal",), _vectors, undistorted=undistorted)
    return from_maps.normals_from(maps, axes, error_deg=error_deg)


def _vectors(path: Path, layer: Layer) -> np.ndarray:
    values = layer.values
    if values.shape[2] != 3:
        guess = "Are they labels?" if layer.labelled else "Is it depth?"
        raise InputError(f"{path}: has one value a pixel; needed: normals, of three. {guess}")
    low, high = float(np.nanmin(values, initial=0)), float(np.nanmax(values, initial=0))
    if low >= 0 and 127.5 < high <= 255:  # some component is above 0
        raise InputError(
            f"{path}: holds values from {low:g} to {high:g}; needed: unit normals, or (n + 1) / 2 "
            "from 0 to 1. Divide levels by 255, or write them as whole numbers of 8 bits."
        )
    return values


def read_depth(
    folder: Path | str,
    views: Views,
    inverse: bool | None = None,
    *,
    along: Literal["axis", "ray"] = "axis",
    gauge: Literal["scene", "scale", "affine"] = "affine",
    error: float = DEPTH_ERROR,
    undistorted: bool = False,
) -> DepthPrior:
    """Read depth of photographs from a folder: PNG of 8 or 16 bits, EXR, NPZ or NPY.

    A map has the photograph's name, with words that estimators append, its shape, and any size. 0,
    NaN, infinity, 1e10, and 65504 and 65535 far from other values are unknown; a warning counts
    them.
    PNG counts in its full scale, that of MoGe in metres (text ``near`` and ``far``).
    ``NAME_variance.npy``, or ``variance`` in NPZ and EXR, has squared units.

    Args:
        inverse: Whether maps hold one over depth (disparity: Depth Anything 2, MiDaS); ``None``
            finds this, ``along`` and ``gauge`` by the scene.
        along: The camera's axis, or the pixel's ray (MVE, Blender).
        gauge: ``scale`` of depth in metres, ``affine`` of Marigold, GeoWizard, Lotus and of
            disparity, ``scene`` of the cameras that are given.
        error: Root mean square, where no file has a variance: relative to depth, or to the range
            of a map's values where these have an offset of their own.
        undistorted: Whether they are of the photographs as a run undistorts them.
    """
    kinds = ("depth", "disp", "dist", "z")
    lost: Counter[str] = Counter()

    def distances(path: Path, layer: Layer) -> np.ndarray:
        values = single(path, layer)
        if layer.labelled:
            raise InputError(f"{path}: holds whole numbers below {LABELS}, labels; needed: depth.")
        levels = values * (layer.full or 1)
        # Programs write infinity where there is no depth; 1e10; and the largest half, or whole
        # number of 16 bits, unless other values come within a tenth (a choice) of it, as of a map
        # that was stretched to full scale.
        none = np.isinf(levels) | (levels >= 1e10)
        for one in (65504, 65535):
            if not ((levels > 0.9 * one) & (levels != one) & ~none).any():
                none |= levels == one
        for one, count in zip(*np.unique(levels[none], return_counts=True), strict=True):
            lost[f"{one:g}"] += int(count)
        return np.where(none, np.float32(np.nan), values)

    maps = read_maps(folder, views, kinds, distances, undistorted=undistorted)
    if lost:
        caution(
            f"{folder}: {sum(lost.values()):,} pixels hold {some(sorted(lost))}, which is "
            "taken for no depth.",
            stacklevel=2,
        )
    return from_maps.depth_from(maps, inverse, along=along, gauge=gauge, error=error)
