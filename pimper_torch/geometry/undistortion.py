"""Undistortion of photographs to pinhole cameras."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

from pimper_torch.geometry import lens_models
from pimper_torch.geometry.pixels import grid_from_pixels, pixel_centers
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import CameraModel, Views
from pimper_torch.records.shapes import Mask, Matrix3
from pimper_torch.runtime.mapped import zeros
from pimper_torch.runtime.memory import release_memory
from pimper_torch.runtime.parallel import side_by_side

Picture = Float[Tensor, "channel height width"]
Places = Float[Tensor, "1 height width 2"]


def undistort(
    views: Views, lenses: tuple[CameraModel, ...]
) -> tuple[Views, Float[Tensor, "view 3 3"]]:
    """Resample photographs so that straight lines in space are straight in the image.

    The pinholes are those of :func:`pinhole_for`, with the photographs' sizes.

    Returns:
        The views, and ``K`` of each. A pixel from outside the photograph is zero and false in the
        masks, which are created if needed; without masks and without such pixels, they stay
        ``None``. Radiance is interpolated bilinearly, masks at one half; a pixel that touches a
        saturated one is saturated. Differentiable in the radiance. A view without distortion is
        left untouched.
    """
    pinholes = pinholes_for(lenses).to(views.images)
    if all(map(lens_models.is_pinhole, lenses)):
        return views, pinholes
    shape, device = views.images.shape, views.images.device
    images = zeros(shape, views.images.dtype, device)
    valid = zeros((shape[0], *shape[2:]), torch.bool, device)
    is_covered = views.masks is None
    for index, (image, inside) in enumerate(undistorted(views, lenses)):
        height, width = inside.shape
        images[index, :, :height, :width], valid[index, :height, :width] = image, inside
        is_covered = is_covered and bool(inside.all())
    return views.replace(images=images, masks=None if is_covered else valid), pinholes


def undistorted(views: Views, lenses: tuple[CameraModel, ...]) -> Iterator[tuple[Picture, Mask]]:
    """Undistort photographs one by one, as :func:`undistort` does, without padding."""
    shared = source_grid(lenses[0], like=views.images) if len(set(lenses)) == 1 else None

    def resample(index: int) -> tuple[Picture, Mask]:
        lens = lenses[index]
        image = views.images[index, :, : lens.height, : lens.width]
        mask = None if views.masks is None else views.masks[index, : lens.height, : lens.width]
        grid = shared or source_grid(lens, like=views.images)
        if grid is None:  # a lens without distortion
            return image, torch.ones_like(image[0], dtype=torch.bool) if mask is None else mask
        places, inside = grid
        radiance = sampled(image, places).masked_fill_(~inside, 0)
        saturated = image >= SATURATED
        if bool(saturated.any()):
            touched = sampled(saturated.to(image), places) > 1e-3  # tolerates rounded weights
            radiance = torch.where(touched & inside, radiance.clamp_min(1), radiance)
        if mask is not None:
            inside = inside & (sampled(mask[None].to(image), places)[0] > 0.5)
        return radiance, inside

    yield from side_by_side(resample, range(views.num_views))
    release_memory()  # of photographs and grids


def pinholes_for(lenses: tuple[CameraModel, ...]) -> Float[Tensor, "view 3 3"]:
    """Return ``K`` of each lens's :func:`pinhole_for`, in float64."""
    pinholes = {lens: pinhole_for(lens) for lens in dict.fromkeys(lenses)}
    return torch.stack([pinholes[lens] for lens in lenses])


def source_grid(
    lens: CameraModel, like: Tensor, width: int = 0, height: int = 0
) -> tuple[Places, Mask] | None:
    """Return the positions in the photograph of the pinhole image's pixels, and which are inside.

    Args:
        like: With the grid's device and dtype.
        width: Of a map that covers the photograph, in its own pixels; the photograph's by default.

    Returns:
        Positions for ``grid_sample``; ``None`` for a lens without distortion.
    """
    if lens_models.is_pinhole(lens):
        return None
    width, height = width or lens.width, height or lens.height
    sources = photograph_pixels(lens, width, height).to(like)
    size = sources.new_tensor([width, height])
    inside = ((sources >= 0) & (sources <= size)).all(dim=-1)  # false for NaN
    # Within half a pixel of the edge, the edge's pixel is repeated.
    sources = torch.where(inside[..., None], sources, 0.5).clamp_min(0.5)
    return grid_from_pixels(torch.minimum(sources, size - 0.5), width, height)[None], inside


def sampled(raster: Picture, grid: Places) -> Picture:
    """Return a raster at the places of :func:`source_grid`, interpolated bilinearly."""
    return grid_sample(raster[None], grid, mode="bilinear", align_corners=False)[0]


def pinhole_for(lens: CameraModel) -> Matrix3:
    """Choose the pinhole to which a photograph is undistorted; ``K`` in float64.

    It keeps the lens's principal point and, for barrel distortion, its focal length: a rim of the
    photograph is lost, the centre keeps its scale. For pincushion distortion the focal length is
    increased until no pixel is outside the photograph, but at most by a quarter.
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
    """Return the position in the photograph of each pixel of its pinhole image.

    Returns:
        In pixels of the map, float64; NaN where the lens cannot image the direction.
    """
    width, height = width or lens.width, height or lens.height
    K = pinhole_for(lens)
    scale = K.new_tensor([lens.width / width, lens.height / height])
    pixels = pixel_centers(width, height, like=K).reshape(-1, 2)
    sources = torch.empty_like(pixels)
    batches = torch.split(pixels, 2**17), torch.split(sources, 2**17)  # rays need memory
    for batch, into in zip(*batches, strict=True):
        plane = (batch * scale - K[:2, 2]) / K.diagonal()[:2]
        rays = torch.cat([plane, torch.ones_like(plane[:, :1])], dim=1)
        into.copy_(lens_models.distort(lens, rays) / scale)
    return sources.reshape(height, width, 2)
