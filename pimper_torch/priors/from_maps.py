"""Priors of maps that a folder holds, or that a network returned."""

import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.priors.map_config import DEPTH_ERROR, NORMALS_ERROR_DEG, NormalAxes
from pimper_torch.records import DepthPrior, NormalPrior, SilhouettePrior
from pimper_torch.records.priors import AXES, Axes
from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import InputError, some

# Lengths of vectors that are normals, blended where maps were resized. Grey, and the colour 0 that
# marks nothing, are none.
_SHORTEST, _LONGEST = 0.5, 1.5

_AXES: dict[NormalAxes, Axes | None] = {"auto": None, "dsine": "lub", "world": "opencv"}
_AXES |= {axes: axes for axes in AXES}


class Maps(NamedTuple):
    """Maps of photographs, of whatever kind.

    Attributes:
        values: Padded with NaN.
        variance: NaN where it is not known.
        undistorted: Whether they are of the photographs as a run undistorts them.
    """

    names: tuple[str, ...]
    sizes_px: Int[Tensor, "map 2"]
    values: Float[Tensor, "map height width channel"]
    variance: Float[Tensor, "map height width"]
    undistorted: bool

    @property
    def about(self) -> dict[str, Any]:
        """The fields of every kind of prior."""
        return {
            "names": self.names,
            "sizes_px": self.sizes_px,
            "undistorted": self.undistorted,
        }


def stacked(found: Mapping[str, tuple[Tensor, Tensor | None]], undistorted: bool = False) -> Maps:
    """Put maps into one raster.

    Args:
        found: By photograph, values ``height width channel`` and variance, if any.
    """
    sizes = torch.tensor([[one.shape[1], one.shape[0]] for one, _ in found.values()])
    wide, high = sizes.amax(dim=0).tolist()
    first = next(iter(found.values()))[0]
    values = first.new_full((len(found), high, wide, first.shape[2]), torch.nan)
    variance = values[..., 0].clone()
    for index, (one, spread) in enumerate(found.values()):
        height, width = one.shape[:2]
        values[index, :height, :width] = one
        if spread is not None:
            variance[index, :height, :width] = spread
    return Maps(tuple(found), sizes, values, variance, undistorted)


def normals_from(
    maps: Maps, axes: NormalAxes = "auto", *, error_deg: float = NORMALS_ERROR_DEG
) -> NormalPrior:
    """Make a prior of normals; arrays without a negative value hold ``(n + 1) / 2``."""
    require(0 < error_deg <= 180, "error_deg", error_deg, "above 0, at most 180 degrees")
    coded = ~(maps.values < 0).flatten(1).any(dim=1)
    values = torch.where(coded[:, None, None, None], 2 * maps.values - 1, maps.values)
    length = values.norm(dim=-1)
    known = (length > _SHORTEST) & (length < _LONGEST)
    return NormalPrior(
        **maps.about,
        normals=torch.where(known[..., None], normalize(values, dim=-1), 0),
        variance=variance_of(maps, known, math.radians(error_deg) ** 2),
        frame="world" if axes == "world" else "camera",
        axes=_AXES[axes],
    )


def depth_from(
    maps: Maps,
    inverse: bool | None = None,
    *,
    along: Literal["axis", "ray"] = "axis",
    gauge: Literal["scene", "scale", "affine"] = "affine",
    error: float = DEPTH_ERROR,
) -> DepthPrior:
    """Make a prior of depth; 0, NaN and infinity are not depth."""
    require(error > 0, "error", error, "above 0")
    values = maps.values[..., 0]
    known = values.isfinite() & (values != 0)
    values = torch.where(known, values, 0)
    deviation = error * values.detach().abs()
    if inverse is None or gauge == "affine":
        # The ends of a map's range may be strays.
        spans = [
            float(np.diff(np.quantile(one[mask].cpu().numpy(), (0.02, 0.98)))[0])
            if mask.any()
            else 0.0
            for one, mask in zip(values.detach(), known, strict=True)
        ]
        deviation = (error * values.new_tensor(spans)[:, None, None]).expand_as(values)
    return DepthPrior(
        **maps.about,
        depth=values,
        variance=variance_of(maps, known, deviation.square()),
        along=along,
        inverse=inverse,
        gauge=gauge,
    )


def silhouettes_from(maps: Maps) -> SilhouettePrior:
    """Make a prior of silhouettes; NaN is unknown."""
    return SilhouettePrior(**maps.about, inside=maps.values[..., 0].nan_to_num(0.5))


def variance_of(maps: Maps, known: Tensor, default: Tensor | float) -> Tensor:
    """Return the variance of the maps, or the default; infinite where nothing is known."""
    if not bool(known.any()):
        low, high = maps.values.norm(dim=-1).nan_to_num(0).aminmax()
        raise InputError(
            f"The maps of {some(maps.names, most=3)} hold nothing that can be used: values have "
            f"lengths from {float(low):.3g} to {float(high):.3g}; needed: unit normals, or depth."
        )
    variance = torch.where(maps.variance.isfinite(), maps.variance, default)
    return torch.where(known & (variance > 0), variance, torch.inf)
