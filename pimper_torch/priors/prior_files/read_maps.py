"""Depth and normals of a network, from files."""

from collections import Counter
from pathlib import Path
from typing import Literal

import numpy as np

from pimper_torch.io.decode import LABELS
from pimper_torch.priors import from_maps
from pimper_torch.priors.map_config import DEPTH_ERROR, NORMALS_ERROR_DEG, NormalAxes
from pimper_torch.priors.prior_files.folder import read_maps, single_channel
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

    A map has the name of its photograph, with words that networks append, its aspect ratio, and any
    size. PNG and arrays without a negative value contain ``(n + 1) / 2``, up to 1 or 255, except if
    vectors have unit length without decoding. Vectors far from unit length, and NaN, are unknown.
    ``NAME_variance.npy``, or ``variance`` in NPZ and EXR, is the mean squared angular error in
    squared radians.

    Args:
        axes: Of the normals: ``opencv`` (Metric3D, Omnidata, MoGe's arrays), ``opengl`` (Marigold,
            MoGe's PNG, DiLiGenT), ``lub`` or ``dsine`` (DSINE, StableNormal, GeoWizard, Lotus), or
            ``world`` of the given cameras; ``auto`` determines them from the scene.
        error_deg: Root mean square angular error, for maps without a variance.
        undistorted: Whether the maps are for photographs undistorted as a run undistorts them.
    """
    maps = read_maps(folder, views, ("normal",), _vectors, undistorted=undistorted)
    return from_maps.normals_from(maps, axes, error_deg=error_deg)


def _vectors(path: Path, layer: Layer) -> np.ndarray:
    values = layer.values
    if values.shape[2] != 3:
        guess = "Are they labels?" if layer.labelled else "Is it depth?"
        raise InputError(f"{path}: has one value per pixel; needed: normals, with three. {guess}")
    low, high = np.nanmin(values, initial=0), np.nanmax(values, initial=0)
    # Of 8 bits as floating point; at least one component is positive.
    return values / np.float32(255) if low >= 0 and 127.5 < high <= 255 else values


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

    A map has the name of its photograph, with words that networks append, its aspect ratio, and any
    size. 0 and NaN are unknown; so are, with a warning that counts them, infinity and a far plane:
    the largest or smallest value if many pixels have it, far from other values. PNG values are
    fractions of full scale, MoGe's in metres (text ``near`` and ``far``). ``NAME_variance.npy``, or
    ``variance`` in NPZ and EXR, has squared units.

    Args:
        inverse: Whether maps contain inverse depth (disparity: Depth Anything 2, MiDaS); ``None``
            determines this, ``along`` and ``gauge`` from the scene.
        along: The camera's axis, or the pixel's ray (MVE, Blender).
        gauge: ``scale`` for depth in metres, ``affine`` for Marigold, GeoWizard, Lotus and for
            disparity, ``scene`` for the unit of the given cameras.
        error: Root mean square error of maps without a variance: relative to depth, or, if the
            values have an unknown offset, to their range.
        undistorted: Whether the maps are for photographs undistorted as a run undistorts them.
    """
    kinds = ("depth", "disp", "dist", "z")
    markers: Counter[str] = Counter()

    def distances(path: Path, layer: Layer) -> np.ndarray:
        values = single_channel(path, layer)
        if layer.labelled:
            raise InputError(
                f"{path}: has integers below {LABELS}, which are labels; needed: depth."
            )
        missing = np.isinf(values) | (values == _far_plane(values))
        levels = values * (layer.full or 1)
        for marker, count in zip(*np.unique(levels[missing], return_counts=True), strict=True):
            markers[f"{marker:g}"] += int(count)
        return np.where(missing, np.float32(np.nan), values)

    maps = read_maps(folder, views, kinds, distances, undistorted=undistorted)
    if markers:
        caution(
            f"{folder}: {sum(markers.values()):,} pixels contain {some(sorted(markers))}, which is "
            "treated as missing depth.",
            stacklevel=2,
        )
    return from_maps.depth_from(maps, inverse, along=along, gauge=gauge, error=error)


def _far_plane(values: np.ndarray) -> float:
    """Return the depth, or inverse depth, that a program wrote where it has none; else NaN.

    More than a thousandth of the pixels have it, and it is farther from all other values than these
    are from each other: a choice. Walls are nearer to what is in front of them, or vary in depth.
    """
    depths = values[np.isfinite(values) & (values != 0)]
    for end in (depths.max(), depths.min()) if depths.size else ():
        others = depths[depths != end]
        many = len(depths) - len(others) > max(1, values.size / 1000)
        if many and len(others) and np.abs(others - end).min() > np.ptp(others):
            return float(end)
    return np.nan
