"""Normals of an estimator."""

import math
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch.nn.functional import normalize

from pimper_torch.config import require
from pimper_torch.errors import InputError
from pimper_torch.prior_files.folder import read_maps
from pimper_torch.records import NormalPrior, Views

NormalAxes = Literal["auto", "opencv", "opengl", "lub", "dsine", "world"]
# Root mean square that published estimators are off indoors: DSINE (CVPR 2024) has a mean of 16
# degrees on NYUv2, and large errors are many.
NORMALS_ERROR_DEG = 25.0
# Lengths of vectors that are normals, blended where maps were resized. Grey, and the colour 0 that
# marks nothing, are none.
_SHORTEST, _LONGEST = 0.5, 1.5


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

    Raises:
        InputError: A file or its name, shape or values cannot be used: says which.
    """
    require(0 < error_deg <= 180, "error_deg", error_deg, "above 0, at most 180 degrees")
    maps = read_maps(folder, views, ("normal",), _vectors)
    values = maps.values
    coded = ~((values < 0).flatten(1).any(dim=1))
    values = torch.where(coded[:, None, None, None], 2 * values - 1, values)
    length = values.norm(dim=-1)
    known = (length > _SHORTEST) & (length < _LONGEST)
    variance = torch.where(maps.variance.isfinite(), maps.variance, math.radians(error_deg) ** 2)
    return NormalPrior(
        names=maps.names,
        sizes_px=maps.sizes_px,
        undistorted=undistorted,
        normals=torch.where(known[..., None], normalize(values, dim=-1), 0),
        variance=torch.where(known & (variance > 0), variance, torch.inf),
        frame="world" if axes == "world" else "camera",
        axes=_AXES[axes],
    )


_AXES: dict[NormalAxes, Literal["opencv", "opengl", "lub"] | None] = {
    "auto": None,
    "opencv": "opencv",
    "opengl": "opengl",
    "lub": "lub",
    "dsine": "lub",
    "world": "opencv",
}


def _vectors(path: Path, values: np.ndarray) -> np.ndarray:
    if values.shape[2] != 3:
        raise InputError(f"{path}: has one value a pixel; needed: normals, of three. Is it depth?")
    return values
