"""Photographs as a pinhole would have taken them."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from pimper_torch.geometry.pixels import grid_from_pixels, pixel_centers
from pimper_torch.progress import track
from pimper_torch.records import Lens, Views
from pimper_torch.sfm.colmap import distort, is_pinhole, pinhole_of


def undistort(views: Views, lenses: tuple[Lens, ...]) -> tuple[Views, Float[Tensor, "view 3 3"]]:
    """Resample photographs so that straight lines in space are straight in the image.

    The pinhole keeps the lens's focal length and principal point and the photograph's
    size: at the image's centre one pixel stays one pixel, and nothing moves there. A lens
    that pulls the corners in (pincushion) leaves pixels of the pinhole without a source;
    they become zero and false in the masks. One that bulges (barrel) loses a rim of the
    photograph instead.

    Args:
        views: Any; padding stays zero.
        lenses: One a view, of the photograph's size.

    Returns:
        The views, and ``K`` of each. Masks come to be where something fell outside, and
        stay ``None`` where nothing did. Radiance is interpolated bilinearly, masks at one
        half; differentiable in the radiance. A view without distortion is left untouched.
    """
    images, inside = [], []
    for index in track(range(views.num_views)):
        image, valid = _undistort_image(views, index, lenses[index])
        images.append(image)
        inside.append(valid)
    intrinsics = torch.stack([pinhole_of(lens) for lens in lenses]).to(views.images)
    valid = torch.stack(inside)
    whole = bool((valid == views.inside).all())
    masks = views.masks
    if masks is not None or not whole:
        masks = valid
    return views.replace(images=torch.stack(images), masks=masks), intrinsics


def _undistort_image(
    views: Views, index: int, lens: Lens
) -> tuple[Float[Tensor, "channel height width"], Bool[Tensor, "height width"]]:
    image, inside = views.images[index], views.inside[index]
    mask = inside if views.masks is None else inside & views.masks[index]
    if is_pinhole(lens):
        return image, mask
    height, width = image.shape[-2:]
    sources = photograph_pixels(lens).to(image)
    size = sources.new_tensor([lens.width, lens.height])
    within = ((sources >= 0) & (sources <= size)).all(dim=-1)  # false for NaN
    # Half a pixel from the edge on, the edge's own pixel continues; never the padding.
    sources = torch.where(within[..., None], sources, 0.5).clamp_min(0.5)
    grid = grid_from_pixels(torch.minimum(sources, size - 0.5), width, height)
    stacked = torch.cat([image, mask[None].to(image)])[None]
    sampled = grid_sample(stacked, grid[None], mode="bilinear", align_corners=False)[0]
    sampled = torch.where(within, sampled, 0)
    padding = (0, width - lens.width, 0, height - lens.height)
    sampled = torch.nn.functional.pad(sampled, padding)
    return sampled[:-1], sampled[-1] > 0.5


def photograph_pixels(lens: Lens) -> Float[Tensor, "height width 2"]:
    """Find where in the photograph each pixel of its pinhole image comes from.

    Returns:
        Pixels of the photograph in float64; NaN where the lens cannot image the direction.
    """
    K = pinhole_of(lens)
    pixels = pixel_centers(lens.width, lens.height, like=K).reshape(-1, 2)
    rays = torch.cat([(pixels - K[:2, 2]) / K.diagonal()[:2], torch.ones_like(pixels[:, :1])], 1)
    return distort(lens, rays).reshape(lens.height, lens.width, 2)
