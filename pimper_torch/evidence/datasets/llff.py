"""LLFF: ``poses_bounds.npy`` beside a folder of photographs."""

import re
from pathlib import Path
from typing import Unpack

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.camera_files.layout import expect, first_of
from pimper_torch.camera_files.posed_camera import rigid_or_refuse
from pimper_torch.errors import InputError
from pimper_torch.evidence.datasets.posed import (
    PosedOptions,
    PosedPhotograph,
    assemble,
    image_files,
    mask_finder,
)
from pimper_torch.geometry.frames import invert_rigid
from pimper_torch.numpy_files import read_npy
from pimper_torch.records import Capture, Lens

_KIND = "an LLFF set"
_MASK_FOLDERS = ("masks", "mask", "images_mask")


def read_llff(
    folder: Path | str,
    *,
    images: Path | str | None = None,
    masks: Path | str | None = None,
    **options: Unpack[PosedOptions],
) -> Capture:
    """Read the cameras of ``poses_bounds.npy`` and the photographs beside it.

    A row of the file has 17 numbers: a 3x5 matrix, row by row, and the nearest and farthest
    depth. The matrix's columns are, in the world frame, the camera's directions *down, right
    and back*, its position, and (height, width, focal length). So
    ``world_from_cam = [column 1, column 0, -column 2, column 3]`` for our right, down,
    forward. (LLFF's README, "Using your own poses without running COLMAP", and its
    ``poses/pose_utils.py``.)

    The file has no principal point. LLFF made it with COLMAP's ``SIMPLE_RADIAL``, which
    keeps the principal point at (width / 2, height / 2) from the corner of the image, and
    drops the distortion: so do we, no half pixel is added. The rows belong to the
    photographs in plain order of their names (``1, 10, 11, 2``).

    Args:
        folder: With ``poses_bounds.npy``.
        images: Folder of photographs, full size or a smaller copy, by path or by its name in
            ``folder``; by default ``images``, else the largest of ``images_2``, ``images_4``
            and so on.
        masks: Folder of masks; by default ``masks``, ``mask`` or ``images_mask``, if there is
            one.
        options: See :class:`~pimper_torch.evidence.datasets.posed.PosedOptions`.

    Raises:
        InputError: The folder is laid out otherwise, there is not one photograph a row, or a
            file is damaged.
    """
    folder = Path(folder)
    rows = _read_rows(folder / "poses_bounds.npy", folder)
    files = image_files(_image_folder(folder, images), _KIND)
    expect(
        len(files) == len(rows),
        folder,
        _KIND,
        f"{len(rows)} photographs, one for each row of poses_bounds.npy (move those that COLMAP "
        "did not register to another folder)",
        f"{len(files)}",
    )
    mask_of = mask_finder(masks or first_of([folder / name for name in _MASK_FOLDERS]), _KIND)
    photographs = [
        PosedPhotograph(
            name=path.name,
            image=path,
            mask=mask_of(path),
            lens=_lens(row, folder),
            cam_from_world=_cam_from_world(row, folder),
        )
        for path, row in zip(files, rows, strict=True)
    ]
    return assemble(photographs, folder, _KIND, **options)


def _read_rows(path: Path, folder: Path) -> Float[Tensor, "view 3 5"]:
    expect(path.is_file(), folder, _KIND, "a file poses_bounds.npy")
    try:
        rows = read_npy(path)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}); needed: an array of numbers as numpy.save writes "
            "it. Copy it again."
        ) from error
    ok = rows.ndim == 2 and rows.shape[1] == 17
    ok = ok and rows.dtype.kind == "f" and bool(np.isfinite(rows).all())
    expect(ok, path, _KIND, "finite numbers of shape (views, 17)", f"shape {rows.shape}")
    return torch.from_numpy(rows[:, :15].reshape(-1, 3, 5).astype(np.float64))


def _image_folder(folder: Path, images: Path | str | None) -> Path:
    if images is not None:
        return first_of([folder / images, Path(images)]) or folder / images
    reduced = [
        (int(found.group(1)), path)
        for path in folder.iterdir()
        if (found := re.fullmatch(r"images_(\d+)", path.name))
    ]
    whole = folder / "images"
    expect(
        whole.is_dir() or bool(reduced), folder, _KIND, "a folder `images`, or `images_4` and such"
    )
    return whole if whole.is_dir() else min(reduced)[1]


def _lens(row: Float[Tensor, "3 5"], folder: Path) -> Lens:
    height, width, focal_px = (float(value) for value in row[:, 4])
    expect(
        min(height, width, focal_px) > 0 and height.is_integer() and width.is_integer(),
        folder,
        _KIND,
        "height, width and focal length in column 5",
        f"{height}, {width}, {focal_px}",
    )
    return Lens(
        camera=1,
        model="SIMPLE_PINHOLE",
        params=(focal_px, width / 2, height / 2),
        width=int(width),
        height=int(height),
    )


def _cam_from_world(row: Float[Tensor, "3 5"], folder: Path) -> Float[Tensor, "4 4"]:
    down, right, back, center = row[:, :4].unbind(dim=1)
    rotation = torch.stack([right, down, -back], dim=1)
    return invert_rigid(rigid_or_refuse(rotation, center, "poses_bounds.npy", folder, _KIND))
