"""Depth and normals of an estimator."""

from pathlib import Path
from typing import Literal

import numpy as np

from pimper_torch.priors import from_maps
from pimper_torch.priors.map_config import DEPTH_ERROR, NORMALS_ERROR_DEG, NormalAxes
from pimper_torch.priors.prior_files.folder import read_maps, single
from pimper_torch.records import DepthPrior, NormalPrior, Views
from pimper_torch.runtime.errors import InputError


def read_normals(
    folder: Path | str,
    views: Views,
    axes: NormalAxes = "auto",
    *,
    error_deg: float = NORMALS_ERROR_DEG,
    undistorted: bool = False,
) -> NormalPrior:
    """Read normals of photographs from a folder: PNG of 8 or 16 bits, EXR, NPZ or NPY.

    A map has the photograph's name, with what estimators append, its shape, and any size. PNG, and
    arrays without a negative value, hold ``(n + 1) / 2``. Vectors far from unit length, and NaN,
    say nothing. ``NAME_variance.npy``, or ``variance`` in NPZ and EXR, has the mean square of the
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


def _vectors(path: Path, values: np.ndarray) -> np.ndarray:
    if values.shape[2] != 3:
        raise InputError(f"{path}: has one value a pixel; needed: normals, of three. Is it depth?")
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

    A map has the photograph's name, with what estimators append, its shape, and any size. 0, NaN
    and infinity say nothing. PNG counts in its full scale, that of MoGe in metres (text ``near``
    and ``far``). ``NAME_variance.npy``, or ``variance`` in NPZ and EXR, has squared units.

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
    maps = read_maps(folder, views, kinds, single, undistorted=undistorted)
    return from_maps.depth_from(maps, inverse, along=along, gauge=gauge, error=error)
