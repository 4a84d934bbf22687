"""Photographs small enough to stand in a scene."""

import numpy as np

from pimper_torch.mapped import each
from pimper_torch.radiometry import to_bytes
from pimper_torch.records import Views
from pimper_torch.report.page_pictures import shrunk


def small_pictures(views: Views) -> list[np.ndarray]:
    """Shrink photographs, without the padding of the raster, to 8-bit sRGB."""
    pictures = []
    for (image,), (width, height) in zip(each(views.images), views.sizes_px.tolist(), strict=True):
        small = shrunk(image[:, :height, :width].detach().cpu().clamp(0, 1), 256)
        pictures.append(to_bytes(small.expand(3, -1, -1)).movedim(0, -1).contiguous().numpy())
    return pictures
