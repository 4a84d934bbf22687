"""Depth of an estimator."""

from pathlib import Path
from typing import Literal

from pimper_torch.prior_files.folder import read_maps, single
from pimper_torch.priors.from_maps import DEPTH_ERROR, depth_from
from pimper_torch.records import DepthPrior, Views


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
    maps = read_maps(folder, views, ("depth", "disp", "dist", "z"), single)
    return depth_from(maps, inverse, along=along, gauge=gauge, error=error, undistorted=undistorted)
