"""Rendered photographs as files."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from kornia.color import linear_rgb_to_rgb
from PIL import Image
from torch import Tensor

from pimper_torch.records import Views


def save_photographs(views: Views, folder: Path | str) -> tuple[Path, ...]:
    """Write views as 8-bit sRGB PNG files, named as the views are.

    Radiance over 1 saturates. The folder is made if it is not there.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for image, name, (width, height) in zip(
        views.images, views.names, views.sizes_px.tolist(), strict=True
    ):
        cropped = image[:, :height, :width].clamp(0, 1).expand(3, -1, -1)
        bytes_ = (255 * linear_rgb_to_rgb(cropped)).round().movedim(0, -1).cpu().numpy()
        paths.append(folder / name)
        Image.fromarray(bytes_.astype(np.uint8)).save(paths[-1])
    return tuple(paths)


def save_masks(
    masks: Bool[Tensor, "view height width"], names: Sequence[str], folder: Path | str
) -> tuple[Path, ...]:
    """Write one PNG file a view, white on the object, named as the views are."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for mask, name in zip(masks, names, strict=True):
        paths.append((folder / name).with_suffix(".png"))
        Image.fromarray(255 * mask.cpu().numpy().astype(np.uint8)).save(paths[-1])
    return tuple(paths)
