"""Photographs and masks of a rendered scene as files."""

from pathlib import Path

import numpy as np
from PIL import Image

from pimper_torch.doors.exchange.picture_files import write_picture


def save_photographs(views, folder):
    """Write 8-bit sRGB PNG files, named as the views are."""
    for index, name in enumerate(views.names):
        write_picture(views, index, Path(folder) / name)


def save_masks(masks, names, folder):
    """Write PNG files, white on the object, named as the views are."""
    Path(folder).mkdir()
    for mask, name in zip(masks, names, strict=True):
        Image.fromarray(255 * mask.numpy().astype(np.uint8)).save(Path(folder) / name)
