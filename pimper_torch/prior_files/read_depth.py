"""Depth of an estimator."""

from pathlib import Path
from typing import Literal

import numpy as np
import torch

from pimper_torch.config import require
from pimper_torch.errors import InputError
from pimper_torch.prior_files.folder import read_maps
from pimper_torch.records import DepthPrior, Views

# Root mean square that published estimators are off indoors, relative to depth: Marigold (CVPR
# 2024) has a mean of 5.5 % on NYUv2 once factor and offset are fitted, and large errors are many.
DEPTH_ERROR = 0.08
_RANGE = (0.02, 0.98)  # of the values of a map: its ends may be strays


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

    Raises:
        InputError: A file or its name, shape or values cannot be used: says which.
    """
    require(error > 0, "error", error, "above 0")
    maps = read_maps(folder, views, ("depth", "disp", "dist", "z"), _single)
    values = maps.values[..., 0]
    known = values.isfinite() & (values != 0)
    values = torch.where(known, values, 0)
    deviation = error * values.abs()
    if inverse is None or gauge == "affine":
        ranges = [
            np.diff(np.quantile(one[mask].numpy(), _RANGE)) if bool(mask.any()) else np.zeros(1)
            for one, mask in zip(values, known, strict=True)
        ]
        spans = torch.from_numpy(np.stack(ranges)).to(values)
        deviation = (error * spans[..., None]).expand_as(values)
    variance = torch.where(maps.variance.isfinite(), maps.variance, deviation.square())
    return DepthPrior(
        names=maps.names,
        sizes_px=maps.sizes_px,
        undistorted=undistorted,
        depth=values,
        variance=torch.where(known & (variance > 0), variance, torch.inf),
        along=along,
        inverse=inverse,
        gauge=gauge,
    )


def _single(path: Path, values: np.ndarray) -> np.ndarray:
    if not (values == values[..., :1]).all(where=np.isfinite(values)):
        raise InputError(
            f"{path}: has colours; needed: one value a pixel, not a picture of it in colours."
        )
    return values[..., :1]
