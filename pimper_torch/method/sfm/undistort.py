"""Photographs as a pinhole would have taken them."""

from collections.abc import Iterator, Mapping
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from pimper_torch.ground.geometry import lens_models
from pimper_torch.ground.geometry.pixels import grid_from_pixels, pixel_centers
from pimper_torch.ground.radiometry import SATURATED
from pimper_torch.ground.shapes import Mask, Matrix3
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
    Views,
)
from pimper_torch.runtime.mapped import zeros
from pimper_torch.runtime.memory import release_memory
from pimper_torch.runtime.parallel import side_by_side

Picture = Float[Tensor, "channel height width"]
Places = Float[Tensor, "1 height width 2"]


def undistort(
    views: Views, lenses: tuple[CameraModel, ...]
) -> tuple[Views, Float[Tensor, "view 3 3"]]:
    """Resample photographs so that straight lines in space are straight in the image.

    The pinholes are those of :func:`pinhole_for`, of the photographs' sizes.

    Returns:
        The views, and ``K`` of each. A pixel that looks past the photograph's edge is zero
        and false in the masks, which come to be for that; where there are none and nothing
        looks past, they stay ``None``. Radiance is interpolated bilinearly, masks at one
        half; what touches a saturated pixel is saturated. Differentiable in the radiance. A
        view without distortion is left untouched.
    """
    pinholes = pinholes_for(lenses).to(views.images)
    if all(map(lens_models.is_pinhole, lenses)):
        return views, pinholes
    shape, device = views.images.shape, views.images.device
    images = zeros(shape, views.images.dtype, device)
    valid = zeros((shape[0], *shape[2:]), torch.bool, device)
    whole = views.masks is None
    for index, (image, inside) in enumerate(undistorted(views, lenses)):
        height, width = inside.shape
        images[index, :, :height, :width], valid[index, :height, :width] = image, inside
        whole = whole and bool(inside.all())
    return views.replace(images=images, masks=None if whole else valid), pinholes


def undistorted(views: Views, lenses: tuple[CameraModel, ...]) -> Iterator[tuple[Picture, Mask]]:
    """Undistort photographs one by one, as :func:`undistort` does, without padding."""
    shared = source_grid(lenses[0], like=views.images) if len(set(lenses)) == 1 else None

    def one(index: int) -> tuple[Picture, Mask]:
        lens = lenses[index]
        image = views.images[index, :, : lens.height, : lens.width]
        mask = None if views.masks is None else views.masks[index, : lens.height, : lens.width]
        grid = shared or source_grid(lens, like=views.images)
        if grid is None:  # a lens without distortion
            return image, torch.ones_like(image[0], dtype=torch.bool) if mask is None else mask
        places, inside = grid
        radiance = _sampled(image, places).masked_fill_(~inside, 0)
        saturated = image >= SATURATED
        if bool(saturated.any()):
            touched = _sampled(saturated.to(image), places) > 1e-3  # the rounding of weights
            radiance = torch.where(touched & inside, radiance.clamp_min(1), radiance)
        if mask is not None:
            inside = inside & (_sampled(mask[None].to(image), places)[0] > 0.5)
        return radiance, inside

    yield from side_by_side(one, range(views.num_views))
    release_memory()  # of the photographs, and of their grids


def pinholes_for(lenses: tuple[CameraModel, ...]) -> Float[Tensor, "view 3 3"]:
    """Return ``K`` of each lens's :func:`pinhole_for`, in float64."""
    found = {lens: pinhole_for(lens) for lens in dict.fromkeys(lenses)}
    return torch.stack([found[lens] for lens in lenses])


def source_grid(
    lens: CameraModel, like: Tensor, width: int = 0, height: int = 0
) -> tuple[Places, Mask] | None:
    """Return where pixels of the pinhole image are in the photograph, and which are in it at all.

    Args:
        like: Of the grid's device and type.
        width: Of a map that covers the photograph, in its own pixels; the photograph's by default.

    Returns:
        Places for ``grid_sample``; nothing for a lens without distortion.
    """
    if lens_models.is_pinhole(lens):
        return None
    width, height = width or lens.width, height or lens.height
    sources = photograph_pixels(lens, width, height).to(like)
    size = sources.new_tensor([width, height])
    within = ((sources >= 0) & (sources <= size)).all(dim=-1)  # false for NaN
    # Half a pixel from the edge on, the edge's own pixel continues.
    sources = torch.where(within[..., None], sources, 0.5).clamp_min(0.5)
    return grid_from_pixels(torch.minimum(sources, size - 0.5), width, height)[None], within


def _sampled(raster: Picture, grid: Places) -> Picture:
    return grid_sample(raster[None], grid, mode="bilinear", align_corners=False)[0]


def pinhole_for(lens: CameraModel) -> Matrix3:
    """Choose the pinhole that a photograph is undistorted to; ``K`` in float64.

    It keeps the lens's principal point and, for a lens that bulges (barrel), its focal
    length: a rim of the photograph is lost, the centre keeps its scale. For a lens that
    pulls the corners out (pincushion) the focal length grows until no pixel looks past the
    photograph's edge, but never by more than a quarter.
    """
    K = lens_models.pinhole_of(lens)
    if lens_models.is_pinhole(lens):
        return K
    size = K.new_tensor([lens.width, lens.height])
    along = torch.linspace(0, 1, 65, dtype=K.dtype)[:, None] * size  # 64 steps: smooth curves
    zoom = torch.ones(())
    for axis, end in ((0, 0), (0, lens.width), (1, 0), (1, lens.height)):
        edge = along.clone()
        edge[:, axis] = end
        straight = lens_models.undistort_pixels(lens, edge)[:, axis]
        reach = straight.nan_to_num(nan=torch.inf).abs().min()
        needed = (end - K[axis, 2]).abs() / K[axis, axis]
        zoom = torch.maximum(zoom, needed / reach.clamp_min(1e-12))
    zoom = zoom.clamp_max(1.25)
    return torch.stack([K[0] * K.new_tensor([zoom, 1, 1]), K[1] * K.new_tensor([1, zoom, 1]), K[2]])


def photograph_pixels(
    lens: CameraModel, width: int = 0, height: int = 0
) -> Float[Tensor, "height width 2"]:
    """Find where in the photograph each pixel of its pinhole image comes from.

    Returns:
        In pixels of the map, float64; NaN where the lens cannot image the direction.
    """
    width, height = width or lens.width, height or lens.height
    K = pinhole_for(lens)
    scale = K.new_tensor([lens.width / width, lens.height / height])
    pixels = pixel_centers(width, height, like=K).reshape(-1, 2)
    found = torch.empty_like(pixels)
    parts = torch.split(pixels, 2**17), torch.split(found, 2**17)  # rays take memory
    for some, into in zip(*parts, strict=True):
        plane = (some * scale - K[:2, 2]) / K.diagonal()[:2]
        rays = torch.cat([plane, torch.ones_like(plane[:, :1])], dim=1)
        into.copy_(lens_models.distort(lens, rays) / scale)
    return found.reshape(height, width, 2)


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


def _straight(one: AnyMap, lens: CameraModel | None) -> AnyMap:
    """Resample one map; the rest of its raster stays as it is."""
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
        values = torch.where(grid[1], _sampled(values[0], grid[0])[None], 0.5)  # says nothing
    found = _filled(raster, values)
    changes[field] = found.movedim(1, -1) if is_normals else found.reshape(before.shape)
    return one.replace(**changes)


def _filled(raster: Tensor, values: Tensor) -> Tensor:
    """Put values into the upper left corner of a copy."""
    after = raster.clone()
    after[..., : values.shape[-2], : values.shape[-1]] = values.to(raster)
    return after


def _weighted(
    values: _Raster, variance: Float[Tensor, "1 height width"], places: Places, inside: Mask
) -> tuple[_Raster, Float[Tensor, "1 height width"], _Raster]:
    """Return means by precision, one over the mean precision, and variances about the means."""
    known = variance.isfinite()
    precision = torch.where(known, 1 / torch.where(known, variance, 1), 0)[:, None]
    values = torch.where(known[:, None], values, 0)
    stacked = torch.cat([precision, precision * values, precision * values.square()], dim=1)
    sums = _sampled(stacked[0], places)[None]
    known = inside & (sums[:, :1] > 0)
    weight = torch.where(known, sums[:, :1], 1)
    mean, square = (sums[:, 1:] / weight).chunk(2, dim=1)
    error = torch.where(known, 1 / weight, torch.inf)[:, 0]
    return mean, error, (square - mean.square()).clamp_min(0)
