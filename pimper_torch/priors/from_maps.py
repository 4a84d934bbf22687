"""Priors from maps of a folder or of a network."""

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

# Lengths of normals, which are blended where maps were resized. Grey, and the colour 0 of missing
# values, are outside.
_SHORTEST, _LONGEST = 0.5, 1.5

_AXES: dict[NormalAxes, Axes | None] = {"auto": None, "dsine": "lub", "world": "opencv"}
_AXES |= {axes: axes for axes in AXES}


class Maps(NamedTuple):
    """Maps of photographs, of any kind.

    Attributes:
        values: Padded with NaN.
        variance: NaN where unknown.
        undistorted: Whether the maps are for photographs undistorted as a run undistorts them.
    """

    names: tuple[str, ...]
    sizes_px: Int[Tensor, "map 2"]
    values: Float[Tensor, "map height width channel"]
    variance: Float[Tensor, "map height width"]
    undistorted: bool

    @property
    def about(self) -> dict[str, Any]:
        """Fields that all kinds of priors share."""
        return {"names": self.names, "sizes_px": self.sizes_px, "undistorted": self.undistorted}


def padded(maps: Mapping[str, tuple[Tensor, Tensor | None]], undistorted: bool = False) -> Maps:
    """Stack maps, padded to one size.

    Args:
        maps: Values ``height width channel`` and variance, if any, by photograph.
    """
    sizes = torch.tensor([layer.shape[1::-1] for layer, _ in maps.values()], device="cpu")
    max_width, max_height = sizes.amax(dim=0).tolist()
    first = next(iter(maps.values()))[0]
    shape = len(maps), max_height, max_width, first.shape[2]
    dtype = torch.promote_types(first.dtype, torch.float32)  # from half precision, as by autocast
    values = first.new_full(shape, torch.nan, dtype=dtype)
    variance = values[..., 0].clone()
    for index, (layer, layer_variance) in enumerate(maps.values()):
        height, width = layer.shape[:2]
        values[index, :height, :width] = layer
        if layer_variance is not None:
            variance[index, :height, :width] = layer_variance
    return Maps(tuple(maps), sizes, values, variance, undistorted)


def normals_from(
    maps: Maps, axes: NormalAxes = "auto", *, error_deg: float = NORMALS_ERROR_DEG
) -> NormalPrior:
    """Return a prior of normals; nonnegative maps contain ``(n + 1) / 2`` if more are unit then."""
    require(0 < error_deg <= 180, "error_deg", error_deg, "above 0, at most 180 degrees")
    decoded = 2 * maps.values - 1
    unit, unit_decoded = (
        ((vectors.norm(dim=-1) - 1).abs() < 0.05).flatten(1).sum(dim=1)  # 8 bits: 0.01
        for vectors in (maps.values, decoded)
    )
    encoded = ~(maps.values < 0).flatten(1).any(dim=1) & (unit_decoded >= unit)
    values = torch.where(encoded[:, None, None, None], decoded, maps.values)
    length = values.norm(dim=-1)
    valid = (length > _SHORTEST) & (length < _LONGEST)
    return NormalPrior(
        **maps.about,
        normals=torch.where(valid[..., None], normalize(values, dim=-1), 0),
        variance=variance_of(maps, valid, math.radians(error_deg) ** 2),
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
    """Return a prior of depth; 0, NaN and infinity are missing values."""
    require(error > 0, "error", error, "above 0")
    values = maps.values[..., 0]
    valid = values.isfinite() & (values != 0)
    values = torch.where(valid, values, 0)
    deviation = error * values.detach().abs()
    if inverse is None or gauge == "affine":
        # Quantiles, as the ends of a map's range may be outliers.
        spans = [
            np.ptp(np.quantile(layer[mask].cpu().numpy(), (0.02, 0.98))) if mask.any() else 0.0
            for layer, mask in zip(values.detach(), valid, strict=True)
        ]
        deviation = (error * values.new_tensor(spans)[:, None, None]).expand_as(values)
    return DepthPrior(
        **maps.about,
        depth=values,
        variance=variance_of(maps, valid, deviation.square()),
        along=along,
        inverse=inverse,
        gauge=gauge,
    )


def silhouettes_from(maps: Maps) -> SilhouettePrior:
    """Return a prior of silhouettes; NaN is unknown."""
    return SilhouettePrior(**maps.about, inside=maps.values[..., 0].nan_to_num(0.5))


def variance_of(maps: Maps, valid: Tensor, default: Tensor | float) -> Tensor:
    """Return the variance of the maps, else the default; infinite where values are not valid."""
    if not bool(valid.any()):
        low, high = maps.values.norm(dim=-1).nan_to_num(0).aminmax()
        raise InputError(
            f"The maps of {some(maps.names, most=3)} contain no usable values: their lengths are "
            f"{float(low):.3g} to {float(high):.3g}; needed: unit normals, or depth."
        )
    variance = torch.where(maps.variance.isfinite(), maps.variance, default)
    return torch.where(valid & (variance > 0), variance, torch.inf)
