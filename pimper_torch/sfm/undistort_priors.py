"""Priors of the original photographs as priors of the undistorted ones."""

from collections.abc import Mapping
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from pimper_torch.records import (
    AlbedoPrior,
    DepthPrior,
    InlierPrior,
    Lens,
    LightPrior,
    MapPrior,
    NormalPrior,
    Prior,
    SilhouettePrior,
    SparseScene,
)
from pimper_torch.sfm.undistort import source_grid

_VALUES: dict[type[MapPrior], str] = {
    NormalPrior: "normals",
    DepthPrior: "depth",
    AlbedoPrior: "albedo",
    InlierPrior: "probability",
    SilhouettePrior: "inside",
}
_Raster = Float[Tensor, "1 channel height width"]
AnyMap = TypeVar("AnyMap", bound=MapPrior)
_UNKNOWN = 0.5  # a probability that says nothing


def with_undistorted_priors(scene: SparseScene) -> SparseScene:
    """Resample the priors of the original photographs as these were undistorted.

    Means of what a pixel touches count by their precision; its variance is theirs and that of the
    values among them, so that it is large at edges. What looks past the photograph's edge is not
    known: variance is infinite, and probability one half. Maps keep their sizes. A photograph
    without distortion keeps its map bit for bit. Differentiable in values and variances.

    Args:
        scene: Where it has no lenses, its photographs came without distortion.

    Returns:
        With maps of the scene's own views; the scene itself where there is nothing to do.
    """
    priors = scene.views.priors
    if all(isinstance(prior, LightPrior) or prior.undistorted for prior in priors):
        return scene
    lenses: dict[str, Lens | None] = dict.fromkeys(scene.views.names)
    lenses |= dict(zip(scene.views.names, scene.lenses, strict=False))
    placed: tuple[Prior, ...] = tuple(
        prior if isinstance(prior, LightPrior) or prior.undistorted else _undistorted(prior, lenses)
        for prior in priors
    )
    return scene.replace(views=scene.views.replace(priors=placed))


def _undistorted(prior: AnyMap, lenses: Mapping[str, Lens | None]) -> AnyMap:
    straight = [
        _straight(prior.take([index]), lenses[name])
        for index, name in enumerate(prior.names)
        if name in lenses
    ]
    return type(prior).cat(straight or [prior.take([])]).replace(undistorted=True)


def _straight(one: AnyMap, lens: Lens | None) -> AnyMap:
    """Resample one map; what lies beside it in its raster stays as it is."""
    width, height = one.sizes_px[0].tolist()
    grid = source_grid(lens, one.sizes_px.double(), width, height) if lens else None
    if grid is None:
        return one
    field = _VALUES[type(one)]
    before, is_normals = getattr(one, field), isinstance(one, NormalPrior)
    raster = before.movedim(-1, 1) if is_normals else before.reshape(1, -1, *before.shape[-2:])
    values = raster[..., :height, :width].double()
    changes = {}
    if isinstance(one, NormalPrior | DepthPrior | AlbedoPrior):
        known = one.variance[:, :height, :width].double()
        values, error, spread = _weighted(values, known, *grid)
        values = normalize(values, dim=1) if is_normals else values
        error = error + (spread.sum(dim=1) if is_normals else spread.mean(dim=1))
        changes["variance"] = _filled(one.variance, error)
    else:
        values = torch.where(grid[1], _sampled(values, grid[0]), _UNKNOWN)
    found = _filled(raster, values)
    changes[field] = found.movedim(1, -1) if is_normals else found.reshape(before.shape)
    return one.replace(**changes)


def _filled(raster: Tensor, values: Tensor) -> Tensor:
    """Put values into the upper left corner of a copy."""
    after = raster.clone()
    after[..., : values.shape[-2], : values.shape[-1]] = values.to(raster)
    return after


def _sampled(raster: Tensor, places: Tensor) -> Tensor:
    return grid_sample(raster, places, mode="bilinear", align_corners=False)


def _weighted(
    values: _Raster,
    variance: Float[Tensor, "1 height width"],
    places: Float[Tensor, "1 height width 2"],
    inside: Bool[Tensor, "height width"],
) -> tuple[_Raster, Float[Tensor, "1 height width"], _Raster]:
    """Return means by precision, one over the mean precision, and variances about the means."""
    known = variance.isfinite()
    precision = torch.where(known, 1 / torch.where(known, variance, 1), 0)[:, None]
    values = torch.where(known[:, None], values, 0)
    stacked = torch.cat([precision, precision * values, precision * values.square()], dim=1)
    sums = _sampled(stacked, places)
    known = inside & (sums[:, :1] > 0)
    weight = torch.where(known, sums[:, :1], 1)
    mean, square = (sums[:, 1:] / weight).chunk(2, dim=1)
    error = torch.where(known, 1 / weight, torch.inf)[:, 0]
    return mean, error, (square - mean.square()).clamp_min(0)
