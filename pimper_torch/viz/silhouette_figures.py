"""Photographs with the silhouettes of the object drawn in."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, max_pool2d

from pimper_torch.mapped import drop_pages
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records import Silhouettes, Views

RELIABLE, DOUBTED = (1.0, 0.82, 0.29), (1.0, 0.2, 0.2)


def thumbnails(
    views: Views, silhouettes: Silhouettes, shown: Sequence[int], *, width_px: int, across: int
) -> Float[Tensor, "height width 3"]:
    """Tile small photographs of some views, each with its silhouette as a line of one pixel.

    Args:
        views: Linear radiance.
        silhouettes: Of the same views. Lines are yellow, and red where a view is not trusted.
        shown: Views, in the order of the tiles.

    Returns:
        sRGB in [0, 1]; tiles that are left over are white.
    """
    height, width = views.images.shape[-2:]
    wide = max(1, width_px // across)
    high = max(1, round(wide * height / width))
    rows = -(-len(shown) // across)
    sheet = torch.ones(rows * high, across * wide, 3)
    for place, view in enumerate(shown):
        image = adaptive_avg_pool2d(views.images[view].detach().cpu(), (high, wide))
        inside = adaptive_avg_pool2d(silhouettes.inside[view].cpu()[None], (high, wide))[0]
        tile = srgb_from_linear(image.clamp(0, 1)).expand(3, -1, -1).movedim(0, -1).clone()
        tile[border(inside > 0.5)] = tile.new_tensor(
            RELIABLE if silhouettes.reliable[view] else DOUBTED
        )
        top, left = place // across * high, place % across * wide
        sheet[top : top + high, left : left + wide] = tile
        drop_pages()
    return sheet


def border(mask: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Find pixels of the mask next to others; the picture's edge is no border."""
    beside = max_pool2d((~mask)[None].float(), kernel_size=3, stride=1, padding=1)[0] > 0
    return mask & beside
