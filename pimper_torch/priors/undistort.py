"""Undistortion of priors, with their variances."""

from collections.abc import Mapping
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.undistortion import Places, sampled, source_grid
from pimper_torch.records import (
    AlbedoPrior,
    CameraModel,
    DepthPrior,
    InlierPrior,
    LightPrior,
    MapPrior,
    NormalPrior,
    Prior,
    SilhouettePrior,
    SparseScene,
)
from pimper_torch.records.shapes import Mask

_VALUES: dict[type[MapPrior], str] = {
    NormalPrior: "normals",
    DepthPrior: "depth",
    AlbedoPrior: "albedo",
    InlierPrior: "probability",
    SilhouettePrior: "inside",
}
_Raster = Float[Tensor, "1 channel height width"]
AnyMap = TypeVar("AnyMap", bound=MapPrior)


def with_undistorted_priors(scene: SparseScene) -> SparseScene:
    """Resample priors of the original photographs to the undistorted ones.

    Values are averaged by precision. The variance is one over the mean precision plus the spread of
    the averaged values, so it is large at edges. Pixels from outside the photograph are unknown:
    variance is infinite, and probability one half. Maps keep their sizes. A photograph without
    distortion keeps its map bit for bit. Differentiable in values and variances.

    Args:
        scene: Without lenses, its photographs were loaded without distortion.

    Returns:
        With maps of the scene's own views; the scene itself if nothing needs to be resampled.
    """
    priors = scene.views.priors
    if all(isinstance(prior, LightPrior) or prior.undistorted for prior in priors):
        return scene
    lenses: dict[str, CameraModel | None] = dict.fromkeys(scene.views.names)
    lenses |= dict(zip(scene.views.names, scene.lenses, strict=False))
    placed: tuple[Prior, ...] = tuple(
        prior if isinstance(prior, LightPrior) or prior.undistorted else _undistorted(prior, lenses)
        for prior in priors
    )
    return scene.replace(views=scene.views.replace(priors=placed))


def _undistorted(prior: AnyMap, lenses: Mapping[str, CameraModel | None]) -> AnyMap:
    straight = [
        _straight(prior.take([index]), lenses[name])
        for index, name in enumerate(prior.names)
        if name in lenses
    ]
    return type(prior).cat(straight or [prior.take([])]).replace(undistorted=True)


def _straight(prior: AnyMap, lens: CameraModel | None) -> AnyMap:
    """Resample one map; the rest of its raster is unchanged."""
    width, height = prior.sizes_px[0].tolist()
    grid = source_grid(lens, prior.sizes_px.double(), width, height) if lens else None
    if grid is None:
        return prior
    field = _VALUES[type(prior)]
    before, is_normals = getattr(prior, field), isinstance(prior, NormalPrior)
    raster = before.movedim(-1, 1) if is_normals else before.reshape(1, -1, *before.shape[-2:])
    values = raster[..., :height, :width].double()
    changes = {}
    if isinstance(prior, NormalPrior | DepthPrior | AlbedoPrior):
        variance = prior.variance[:, :height, :width].double()
        values, error, spread = _weighted(values, variance, *grid)
        values = normalize(values, dim=1) if is_normals else values
        error = error + (spread.sum(dim=1) if is_normals else spread.mean(dim=1))
        changes["variance"] = _filled(prior.variance, error)
    else:
        values = torch.where(grid[1], sampled(values[0], grid[0])[None], 0.5)  # no information
    after = _filled(raster, values)
    changes[field] = after.movedim(1, -1) if is_normals else after.reshape(before.shape)
    return prior.replace(**changes)


def _filled(raster: Tensor, values: Tensor) -> Tensor:
    """Return a copy of a raster with values in its upper left corner."""
    after = raster.clone()
    after[..., : values.shape[-2], : values.shape[-1]] = values.to(raster)
    return after


def _weighted(
    values: _Raster, variance: Float[Tensor, "1 height width"], places: Places, inside: Mask
) -> tuple[_Raster, Float[Tensor, "1 height width"], _Raster]:
    """Return means by precision, one over the mean precision, and variances about the means."""
    valid = variance.isfinite()
    precision = torch.where(valid, 1 / torch.where(valid, variance, 1), 0)[:, None]
    values = torch.where(valid[:, None], values, 0)
    stacked = torch.cat([precision, precision * values, precision * values.square()], dim=1)
    sums = sampled(stacked[0], places)[None]
    valid = inside & (sums[:, :1] > 0)
    weight = torch.where(valid, sums[:, :1], 1)
    mean, square = (sums[:, 1:] / weight).chunk(2, dim=1)
    error = torch.where(valid, 1 / weight, torch.inf)[:, 0]
    return mean, error, (square - mean.square()).clamp_min(0)
