"""Photographs and masks as the files of an exported data set."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from pimper_torch.ground.radiometry import to_bytes
from pimper_torch.records import Cameras, Views
from pimper_torch.runtime.errors import InputError, some
from pimper_torch.runtime.progress import track


def write_picture(views: Views, index: int, path: Path) -> None:
    """Write a photograph without its padding as PNG, 8-bit sRGB; more than 1 saturates.

    Folders are made. What came from 8-bit sRGB without undistortion or resizing goes back
    to the same bytes.
    """
    width, height = (int(side) for side in views.sizes_px[index])
    picture = to_bytes(views.images[index, :, :height, :width].detach()).movedim(0, -1)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture.squeeze(-1).cpu().numpy()).save(path)


def write_mask(views: Views, index: int, path: Path) -> None:
    """Write a photograph's mask as PNG, white on the object; all white where there is none."""
    width, height = (int(side) for side in views.sizes_px[index])
    shown = views.inside if views.masks is None else views.masks
    array = shown[index, :height, :width].cpu().numpy().astype(np.uint8) * 255
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path)


def write_pictures(views: Views, folder: Path, mask_suffix: str = "") -> tuple[str, ...]:
    """Write photographs in ``images/``, and in ``masks/`` the masks of the same names if any.

    Args:
        mask_suffix: Behind the names of the masks.

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
    """Name a PNG file for each photograph: no folders, no two the same.

    >>> file_names(["a.jpg", "left/b.tif"])
    ('a.png', 'left_b.png')
    >>> file_names(["a.jpg", "a.png", "b.png"])
    ('a_jpg.png', 'a_png.png', 'b.png')
    """
    parts = [
        [part for part in PurePosixPath(name).parts if part not in ("/", "..")] for name in names
    ]
    whole = ["_".join(part).replace("\\", "_") for part in parts]
    stems = [PurePosixPath(name).stem for name in whole]
    often = Counter(stems)
    plain = [
        stem if often[stem] == 1 else name.replace(".", "_")
        for stem, name in zip(stems, whole, strict=True)
    ]
    if len(set(plain)) < len(plain):
        plain = [f"{index:06d}_{name}" for index, name in enumerate(plain)]
    return tuple(f"{name}.png" for name in plain)


def refuse_skew(cameras: Cameras, names: Sequence[str], kind: str) -> None:
    """Refuse cameras whose pixels are sheared noticeably, for formats that cannot represent it."""
    K = cameras.intrinsics.detach().cpu().double()
    moved = (K[:, 0, 1] / K[:, 1, 1]).abs() * cameras.sizes_px[:, 1].cpu().double() / 2
    # Less is below what calibration knows.
    sheared = [name for name, shift in zip(names, moved.tolist(), strict=True) if shift > 0.01]
    if sheared:
        raise InputError(
            f"the cameras of {some(sheared)} have a skew that moves pixels by up to "
            f"{float(moved.max()):.2g}; needed: none, as {kind} has no place for it. Export to "
            "IDR, which keeps it."
        )
