"""Readers of photographs with cameras, in the layouts of programs and data sets."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Unpack

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_bench.datasets.posed import (
    PosedOptions,
    PosedPhotograph,
    assemble,
    file_in,
    first_of,
    image_files,
    mask_finder,
)
from pimper_bench.truth import Capture
from pimper_torch.geometry.rigid import invert_rigid
from pimper_torch.io.cameras import transforms_json
from pimper_torch.io.cameras.camera_arrays import read_camera_arrays
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.cameras.posed_camera import PosedCamera
from pimper_torch.io.cameras.read_cameras import FORMATS, read_cameras
from pimper_torch.io.decode import read_header
from pimper_torch.io.extras import SUFFIXES
from pimper_torch.records import CameraModel
from pimper_torch.runtime.errors import some
from pimper_torch.runtime.numpy_files import read_npy

_COLMAP = "a COLMAP model with its photographs"
_MODELS = (".", "sparse/0", "sparse", "model", "0")
_LLFF = "an LLFF set"
_LLFF_MASKS = ("masks", "mask", "images_mask")
_IDR = "an IDR or NeuS set"
_IDR_CAMERAS = ("cameras.npz", "cameras_sphere.npz", "cameras_large.npz")
_TRANSFORMS = ("transforms.json", "transforms_train.json")


def read_colmap(
    folder: Path | str,
    *,
    images: Path | str | None = None,
    masks: Path | str | None = None,
    **options: Unpack[PosedOptions],
) -> Capture:
    """Read a COLMAP model, text or binary, and its photographs.

    COLMAP has our pixel convention (centre of the top-left pixel at (0.5, 0.5), "Camera models"
    in its documentation) and our camera axes. Lenses with distortion are undistorted.
    Its cloud is an estimate, so it is not used as truth; ``Reconstruct`` reads it.

    Args:
        folder: With ``cameras``, ``images`` and ``points3D``, or with them in ``sparse/0``,
            ``sparse``, ``model`` or ``0``.
        images: Folder of the photographs; by default ``images`` next to or above the model.
        masks: Folder of masks; by default ``masks`` next to that, if it exists.
    """
    root = DataSetPath(Path(folder), _COLMAP)
    files = [root.path / name / f"cameras{end}" for name in _MODELS for end in (".bin", ".txt")]
    path = first_of(files)
    if path is None:
        root.refuse("cameras.bin or cameras.txt here or in sparse/0")
    around = [*path.parents[:3], root.path]
    pictures = Path(images) if images else first_of([parent / "images" for parent in around])
    if pictures is None or not pictures.is_dir():
        root.refuse("a folder `images` next to or above the model, or that of the photographs")
    model = read_model(path.parent)
    cameras = [
        PosedCamera(name=name, lens=lens, cam_from_world=pose)
        for name, lens, pose in zip(model.names, model.lenses, model.cam_from_world, strict=True)
    ]
    location, masked = root._replace(path=pictures), masks or first_of([pictures.parent / "masks"])
    photographs = _paired(cameras, lambda camera: location.inside(camera.name), masked, location)
    named = [item.replace(name=name) for item, name in zip(photographs, model.names, strict=True)]
    return assemble(named, root._replace(path=path.parent), **options)


def read_llff(
    folder: Path | str,
    *,
    images: Path | str | None = None,
    masks: Path | str | None = None,
    **options: Unpack[PosedOptions],
) -> Capture:
    """Read the cameras of ``poses_bounds.npy`` and the photographs next to it.

    A row of the file has 17 numbers: a 3x5 matrix, row by row, and the nearest and farthest
    depth. The matrix's columns are, in the world frame, the camera's directions *down, right
    and back*, its position, and (height, width, focal length). So
    ``world_from_cam = [column 1, column 0, -column 2, column 3]`` for our right, down,
    forward. (LLFF's README, "Using your own poses without running COLMAP", and its
    ``poses/pose_utils.py``.)

    The file has no principal point. LLFF wrote it from COLMAP's ``SIMPLE_RADIAL``, which
    fixes the principal point at (width / 2, height / 2) from the corner of the image, and
    dropped the distortion. This reader does the same, without adding half a pixel. The rows
    correspond to the photographs sorted by name (``1, 10, 11, 2``).

    Args:
        folder: With ``poses_bounds.npy``.
        images: Folder of photographs, full size or smaller, as a path or as a name in
            ``folder``; by default ``images``, else the largest of ``images_2``, ``images_4``
            and others.
        masks: Folder of masks; by default ``masks``, ``mask`` or ``images_mask``, if one
            exists.
    """
    root = DataSetPath(Path(folder), _LLFF)
    file = root.inner("poses_bounds.npy")
    rows = file.read(read_npy, "a file")
    ok = rows.ndim == 2 and rows.shape[1] == 17 and rows.dtype.kind == "f"
    finite = ok and bool(np.isfinite(rows).all())
    file.expect(finite, "finite numbers of shape (views, 17)", f"shape {rows.shape}")
    paths = image_files(root._replace(path=_llff_images(root, images)))
    root.expect(
        len(paths) == len(rows),
        f"{len(rows)} photographs, one for each row of poses_bounds.npy (move those that COLMAP "
        "did not register to another folder)",
        f"{len(paths)}",
    )
    matrices = torch.from_numpy(rows[:, :15].reshape(-1, 3, 5).astype(np.float64))
    pictures = {path.name: path for path in paths}
    cameras = [_llff_camera(name, row, root) for name, row in zip(pictures, matrices, strict=True)]
    masked = masks or first_of([root.path / name for name in _LLFF_MASKS])
    return assemble(_paired(cameras, lambda c: pictures[c.name], masked, root), root, **options)


def _llff_images(root: DataSetPath, images: Path | str | None) -> Path:
    if images is not None:
        return first_of([root.path / images, Path(images)]) or root.path / images
    reduced = [
        (int(match[1]), path)
        for path in root.path.iterdir()
        if (match := re.fullmatch(r"images_(\d+)", path.name))
    ]
    full_size = root.path / "images"
    root.expect(full_size.is_dir() or bool(reduced), "a folder `images`, or one such as `images_4`")
    return full_size if full_size.is_dir() else min(reduced)[1]


def _llff_camera(name: str, row: Float[Tensor, "3 5"], root: DataSetPath) -> PosedCamera:
    height, width, focal_px = row[:, 4].tolist()
    integers = height.is_integer() and width.is_integer()
    root.expect(
        min(height, width, focal_px) > 0 and integers,
        "height, width and focal length in column 5",
        f"{height}, {width}, {focal_px}",
    )
    params = (focal_px, width / 2, height / 2)
    lens = CameraModel(
        camera=1, model="SIMPLE_PINHOLE", params=params, width=int(width), height=int(height)
    )
    down, right, back, center = row[:, :4].unbind(dim=1)
    rotation = torch.stack([right, down, -back], dim=1)
    pose = invert_rigid(root.rigid(rotation, center, "poses_bounds.npy"))
    return PosedCamera(name=name, lens=lens, cam_from_world=pose)


def read_idr(
    folder: Path | str, *, camera_file: str | None = None, **options: Unpack[PosedOptions]
) -> Capture:
    """Read the cameras of ``cameras.npz`` with ``image/`` and, if it exists, ``mask/``.

    For their meaning, see
    :func:`~pimper_torch.io.cameras.camera_arrays.read_camera_arrays`. ``scale_mat_i``, from
    the unit sphere around the object to the world, is ignored: cameras and truth are in the world's
    units. Arrays and masks correspond to the images sorted by name.

    Args:
        camera_file: Its name; by default ``cameras.npz``, ``cameras_sphere.npz`` or
            ``cameras_large.npz``.
    """
    root = DataSetPath(Path(folder), _IDR)
    file = file_in(folder, (camera_file,) if camera_file else _IDR_CAMERAS, _IDR)
    mask_folder, pictures = root.inner("mask"), root.inner("image")
    files = image_files(pictures)
    masks = image_files(mask_folder) if mask_folder.path.is_dir() else [None] * len(files)
    needed = f"{len(files)} masks, one for each image"
    mask_folder.expect(len(masks) == len(files), needed, f"{len(masks)}")
    names = [path.name for path in files]
    cameras = read_camera_arrays(
        file.path, names, lambda names: _sizes([pictures.inside(name) for name in names])
    )
    photographs = [
        PosedPhotograph.of(camera, path, mask)
        for camera, path, mask in zip(cameras, files, masks, strict=True)
    ]
    return assemble(photographs, root, **options)


def _sizes(images: Sequence[Path]) -> list[tuple[int, int]]:
    headers = [read_header(image) for image in images]
    return [(header.width, header.height) for header in headers]


def read_camera_file(
    folder: Path | str,
    *,
    images: Path | str | None = None,
    masks: Path | str | None = None,
    **options: Unpack[PosedOptions],
) -> Capture:
    """Read a file of cameras in a format of ``--sparse``, such as Metashape's or Meshroom's.

    Args:
        folder: The file, or the folder with one by its usual name, see
            :data:`~pimper_torch.io.cameras.read_cameras.FORMATS`.
        images: Folder of the photographs. They are found by the name in the file, without its
            folders, and if necessary without suffixes. By default ``images`` next to the file, or
            the file's folder.
    """
    file = file_in(folder, [item.name for item in FORMATS], "a file of cameras")
    pictures = _pictures(file, images)
    files = image_files(pictures)

    def find(camera: str) -> Path:
        name = PureWindowsPath(camera).name  # accepts both kinds of slash
        matches = [path for path in files if path.name == name]
        matches = matches or [path for path in files if path.stem == name]
        matches = matches or [path for path in files if path.stem == PureWindowsPath(name).stem]
        listed = some([path.name for path in matches or files])
        pictures.expect(len(matches) == 1, f"one photograph named {name}", listed)
        return matches[0]

    def sizes_of(names: Sequence[str]) -> list[tuple[int, int]]:
        return _sizes([find(name) for name in names])

    cameras = read_cameras(file.path, [path.name for path in files], sizes_of)
    photographs = _paired(cameras, lambda camera: find(camera.name), masks, file)
    return assemble(photographs, file, **options)


def read_transforms(folder: Path | str, **options: Unpack[PosedOptions]) -> Capture:
    """Read the cameras of a ``transforms.json`` and the photographs it names.

    For their meaning, see
    :func:`~pimper_torch.io.cameras.transforms_json.read_nerf`. Lenses are
    undistorted. The mask is ``mask_path`` if a frame has one, else the image's alpha channel.
    Photographs are named by their files, or by full paths in the file if these are not unique.

    Args:
        folder: With ``transforms.json`` or ``transforms_train.json``; or a file of this kind.
    """
    file = file_in(folder, _TRANSFORMS, transforms_json.KIND)
    around = file._replace(path=file.path.parent)
    frames = transforms_json.read_frames(file.path)

    def image_of(name: str) -> Path:
        return _with_suffix(around.inside(name))

    cameras = transforms_json.read_nerf(
        file.path, (), lambda names: _sizes([image_of(name) for name in names])
    )
    images = [image_of(camera.name) for camera in cameras]
    names = [image.name for image in images]
    if len(set(names)) < len(names):
        names = [PurePosixPath(image.relative_to(around.path)).as_posix() for image in images]
    masks = [
        around.inside(str(frame["mask_path"])) if frame.get("mask_path") else None
        for frame in frames
    ]
    photographs = [
        PosedPhotograph.of(*row) for row in zip(cameras, images, masks, names, strict=True)
    ]
    return assemble(photographs, file, **options)


def _with_suffix(image: Path) -> Path:
    """Return the file of a photograph, whose suffix may be missing."""
    if image.suffix.lower() in SUFFIXES:
        return image
    candidates = [image.with_name(image.name + suffix) for suffix in (".png", *SUFFIXES)]
    return first_of(candidates) or candidates[0]


def _pictures(file: DataSetPath, images: Path | str | None) -> DataSetPath:
    """Return the folder of the photographs, by default next to the file of cameras."""
    default = file.path.parent / "images"
    path = Path(images) if images else default if default.exists() else file.path.parent
    return file._replace(path=path)


def _paired(
    cameras: Sequence[PosedCamera],
    find: Callable[[PosedCamera], Path],
    masks: Path | str | None,
    data_set: DataSetPath,
) -> list[PosedPhotograph]:
    """Return the photographs of cameras, with their masks by name."""
    mask_of = mask_finder(masks, data_set.kind)
    pairs = [(camera, find(camera)) for camera in cameras]
    return [PosedPhotograph.of(camera, image, mask_of(image)) for camera, image in pairs]
