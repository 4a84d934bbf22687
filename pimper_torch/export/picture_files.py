"""Photographs and masks as image files of an exported data set."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from pimper_torch.radiometry import to_bytes
from pimper_torch.records import Cameras, Views
from pimper_torch.runtime.errors import InputError, some
from pimper_torch.runtime.progress import track


def write_picture(views: Views, index: int, path: Path) -> None:
    """Write a photograph without padding as 8-bit sRGB PNG; values above 1 saturate.

    Folders are created. A photograph from 8-bit sRGB that was neither undistorted nor resized
    keeps its bytes.
    """
    width, height = (int(side) for side in views.sizes_px[index])
    picture = to_bytes(views.images[index, :, :height, :width].detach()).movedim(0, -1)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture.squeeze(-1).cpu().numpy()).save(path)


def write_mask(views: Views, index: int, path: Path) -> None:
    """Write a photograph's mask as PNG, white on the object; all white without masks."""
    width, height = (int(side) for side in views.sizes_px[index])
    masks = views.inside if views.masks is None else views.masks
    array = masks[index, :height, :width].cpu().numpy().astype(np.uint8) * 255
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path)


def write_pictures(views: Views, folder: Path, mask_suffix: str = "") -> tuple[str, ...]:
    """Write photographs to ``images/``, and masks, if any, to ``masks/`` under the same names.

    Args:
        mask_suffix: Appended to the names of masks.

    Returns:
        The names of the photographs, see :func:`file_names`.
    """
    files = file_names(views.names)
    for index, file in enumerate(track(files)):
        write_picture(views, index, folder / "images" / file)
        if views.masks is not None:
            write_mask(views, index, folder / "masks" / f"{file}{mask_suffix}")
    return files


def file_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return a unique name of a PNG file, without folders, for each photograph.

    >>> file_names(["a.jpg", "left/b.tif"])
    ('a.png', 'left_b.png')
    >>> file_names(["a.jpg", "a.png", "b.png"])
    ('a_jpg.png', 'a_png.png', 'b.png')
    """
    parts = [
        [part for part in PurePosixPath(name).parts if part not in ("/", "..")] for name in names
    ]
    flat = ["_".join(part).replace("\\", "_") for part in parts]
    stems = [PurePosixPath(name).stem for name in flat]
    counts = Counter(stems)
    unique = [
        stem if counts[stem] == 1 else name.replace(".", "_")
        for stem, name in zip(stems, flat, strict=True)
    ]
    if len(set(unique)) < len(unique):
        unique = [f"{index:06d}_{name}" for index, name in enumerate(unique)]
    return tuple(f"{name}.png" for name in unique)


def refuse_skew(cameras: Cameras, names: Sequence[str], kind: str) -> None:
    """Raise an error for cameras with noticeable skew, for formats that cannot represent it."""
    K = cameras.intrinsics.detach().cpu().double()
    shifts_px = (K[:, 0, 1] / K[:, 1, 1]).abs() * cameras.sizes_px[:, 1].cpu().double() / 2
    # Smaller shifts are below the accuracy of calibration.
    skewed = [name for name, shift in zip(names, shifts_px.tolist(), strict=True) if shift > 0.01]
    if skewed:
        raise InputError(
            f"The cameras of {some(skewed)} have a skew that moves pixels by up to "
            f"{float(shifts_px.max()):.2g} pixels; needed: no skew, as {kind} cannot represent it. "
            "Export to IDR, which can."
        )
