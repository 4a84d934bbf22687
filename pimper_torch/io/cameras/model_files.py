"""Readers of COLMAP's model files, text and binary; broken parts of a model are skipped.

The format is that of COLMAP's ``scene/reconstruction_io_*.cc``. Rigs and frames are ignored:
``images`` also contains every pose. Untrusted files are read without COLMAP, whose reader ends the
process on broken ones; nothing is allocated for a count before the file has the bytes.
"""

import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from pimper_torch.geometry.colmap_library import loaded
from pimper_torch.geometry.quarter_turns import count_focals
from pimper_torch.geometry.rigid import rigid
from pimper_torch.records import CameraModel
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.runtime.errors import InputError, caution, some

_PARTS = ("cameras", "images", "points3D")
_POINT2D = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_MAX_COORDINATE = 1e30  # poses and points beyond leave the range of single precision


class _Image(NamedTuple):
    """An image in its file; tracks specify the points of its features."""

    number: int
    pose: tuple[float, ...]  # cam_from_world: a quaternion, real part first, and the translation
    camera: int
    name: str
    pixels: np.ndarray  # of its features, ``feature 2``


class _Point(NamedTuple):
    """A point in its file; its track is ``element 2``: an image and a feature of it."""

    number: int
    xyz: tuple[float, ...]
    track: np.ndarray


@cache
def camera_models() -> dict[int, tuple[str, int]]:
    """Return COLMAP's camera models by number in binary files: name, number of parameters."""
    pycolmap = loaded()
    blank = pycolmap.Camera.create_from_model_name
    return {
        int(kind): (name, len(blank(1, name, 1.0, 1, 1).params))
        for name, kind in pycolmap.CameraModelId.__members__.items()
        if int(kind) >= 0
    }


def read_model(folder: Path) -> SparseModel:
    """Read a COLMAP model: ``cameras``, ``images`` and ``points3D``, all ``.bin`` or all ``.txt``.

    Views and points are sorted by number. Points that are not finite, and observations with an
    unknown image or feature, are skipped with a warning.

    Raises:
        InputError: The folder contains no such files; one is truncated or in a different format; or
            an image is duplicated or has no valid pose or camera.
    """
    ending = _ending(folder)
    if ending is None:
        raise InputError(
            f"{folder} contains no COLMAP model; needed: cameras, images and points3D, all .bin or "
            "all .txt. Give the folder that contains them, often named sparse/0."
        )
    text = ending == ".txt"
    try:
        data = [(folder / f"{part}{ending}").read_bytes() for part in _PARTS]
        lenses = {x.camera: x for x in (_text_cameras if text else _binary_cameras)(data[0])}
        images = sorted((_text_images if text else _binary_images)(data[1]), key=lambda x: x[0])
        points = sorted((_text_points if text else _binary_points)(data[2]), key=lambda x: x[0])
    except (OSError, struct.error, ValueError, LookupError, OverflowError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or "truncated or malformed"
        raise InputError(
            f"The COLMAP model in {folder} cannot be read: {reason}. Export it again with COLMAP's "
            "model_converter, or omit it to run structure from motion."
        ) from None
    names = [image.name for image in images]
    faults = [f"{name} appears twice" for name in sorted(set(names)) if names.count(name) > 1]
    faults += [
        f"{image.name} has no valid pose or camera"
        for image in images
        if not _sound(image, lenses.get(image.camera))
    ]
    if faults:
        raise InputError(
            f"The COLMAP model in {folder} is broken: {some(faults, 4)}. Export it again, or omit "
            "it to run structure from motion."
        )
    # Slow to import.
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    poses = torch.tensor([image.pose for image in images], dtype=torch.float64).reshape(-1, 7)
    model = SparseModel(
        names=tuple(names),
        lenses=tuple(lenses[image.camera] for image in images),
        cam_from_world=rigid(quaternion_to_rotation_matrix(poses[:, :4]), poses[:, 4:]),
    )
    return _with_points(model, images, points, folder)


def largest_model(folder: Path) -> Path:
    """Return a folder with a model, its subfolder with the largest one, or its first JSON file."""
    inner = sorted(folder.iterdir()) if folder.is_dir() and not _ending(folder) else []
    endings = {path: ending for path in inner if (ending := _ending(path))}
    sizes = {path: (path / f"images{ending}").stat().st_size for path, ending in endings.items()}
    first = next((path for path in inner if path.suffix.lower() == ".json"), folder)
    largest = max(sizes, key=sizes.__getitem__, default=first)
    if len(sizes) > 1:
        others = some([path.name for path in sizes if path != largest])
        caution(
            f"{folder} contains {len(sizes)} COLMAP models, each in its own frame. The largest, "
            f"{largest.name}, is used, not {others}. To use another one, give its folder."
        )
    return largest


def _ending(folder: Path) -> str | None:
    """Return the ending of the three files of a model; ``None`` if one is missing."""
    files = {end: [folder / f"{part}{end}" for part in _PARTS] for end in (".bin", ".txt")}
    return next((end for end, paths in files.items() if all(map(Path.is_file, paths))), None)


def _binary_cameras(data: bytes) -> Iterator[CameraModel]:
    (count,), offset = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        camera, kind, width, height = struct.unpack_from("<IiQQ", data, offset)
        model, size = camera_models()[kind]
        params = struct.unpack_from(f"<{size}d", data, offset + 24)
        yield CameraModel(camera=camera, model=model, params=params, width=width, height=height)
        offset += 24 + 8 * size


def _binary_images(data: bytes) -> Iterator[_Image]:
    (count,), offset = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        image, *pose, camera = struct.unpack_from("<I7dI", data, offset)
        end = data.index(b"\0", offset + 64)
        name = data[offset + 64 : end].decode("utf-8", "surrogateescape")
        (features,) = struct.unpack_from("<Q", data, end + 1)
        points = np.frombuffer(data, _POINT2D, features, end + 9)
        yield _Image(image, tuple(pose), camera, name, np.stack([points["x"], points["y"]], axis=1))
        offset = end + 9 + points.nbytes


def _binary_points(data: bytes) -> Iterator[_Point]:
    (count,), offset = struct.unpack_from("<Q", data), 8
    head = struct.Struct("<Q3d3BdQ")
    for _ in range(count):
        point, x, y, z, *_, length = head.unpack_from(data, offset)
        track = np.frombuffer(data, "<u4", 2 * length, offset + head.size)
        yield _Point(point, (x, y, z), track.reshape(-1, 2))
        offset += head.size + track.nbytes


def _lines(data: bytes) -> Iterator[str]:
    text = data.decode("utf-8-sig", "surrogateescape").removesuffix("\n")
    # A name may contain Unicode's other line separators.
    return (line.strip() for line in text.split("\n") if not line.lstrip().startswith("#"))


def _text_cameras(data: bytes) -> Iterator[CameraModel]:
    counts = dict(camera_models().values())
    for line in filter(None, _lines(data)):
        camera, model, width, height, *params = line.split()
        if len(params) != counts[model]:
            raise ValueError(f"{len(params)} parameters of {model}")
        values, size = tuple(map(float, params)), {"width": int(width), "height": int(height)}
        yield CameraModel(camera=int(camera), model=model, params=values, **size)


def _text_images(data: bytes) -> Iterator[_Image]:
    lines = _lines(data)
    for line in lines:
        if line:
            image, *pose, camera, name = line.split(maxsplit=9)  # a name may have spaces
            features = [float(word) for word in next(lines, "").split()]
            pixels = np.array(features, dtype=np.float64).reshape(-1, 3)[:, :2].copy()
            yield _Image(int(image), tuple(map(float, pose)), int(camera), name, pixels)


def _text_points(data: bytes) -> Iterator[_Point]:
    for line in filter(None, _lines(data)):
        point, x, y, z, _, _, _, _, *track = line.split()
        elements = np.array([int(word) for word in track], dtype=np.int64).reshape(-1, 2)
        yield _Point(int(point), (float(x), float(y), float(z)), elements)


def _sound(image: _Image, lens: CameraModel | None) -> bool:
    """Return whether an image has a rotation, a position, and a lens with a focal length."""
    if lens is None or lens.model == "EQUIRECTANGULAR":
        return False
    numbers = (*image.pose, *lens.params)
    rotation = abs(float(np.linalg.norm(image.pose[:4])) - 1) <= 0.1  # other programs round
    sizes = all(0 < side <= 10**6 for side in (lens.width, lens.height))
    focal = min(lens.params[: count_focals(lens)]) > 0
    return rotation and sizes and focal and all(abs(x) < _MAX_COORDINATE for x in numbers)


def _with_points(
    model: SparseModel, images: list[_Image], points: list[_Point], folder: Path
) -> SparseModel:
    """Add the finite points and their observations to the model."""
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    finite = (np.abs(xyz) < _MAX_COORDINATE).all(axis=1)
    number = np.where(finite, np.cumsum(finite) - 1, -1)
    tracks = [point.track.astype(np.int64) for point in points]
    image, feature = np.concatenate([np.zeros((0, 2), np.int64), *tracks]).T
    point = number.repeat([len(track) for track in tracks])
    view_of = {image.number: view for view, image in enumerate(images)}
    view = np.array([view_of.get(number, -1) for number in image.tolist()], np.int64)
    counts = [*(len(image.pixels) for image in images), 0]  # the last one is for missing images
    pixels = np.concatenate([*(image.pixels for image in images), np.full((1, 2), np.nan)])
    valid = (point >= 0) & (feature >= 0) & (feature < np.array(counts)[view])
    index = np.where(valid, np.cumsum([0, *counts[:-1]])[view] + feature, -1)
    valid &= (np.abs(pixels[index]) < _MAX_COORDINATE).all(axis=1)  # false for NaN
    lost, unknown = int((~finite).sum()), int((point >= 0).sum() - valid.sum())
    if lost or unknown:
        caution(
            f"The COLMAP model in {folder} is partly broken. Skipped: {lost} of {len(points)} "
            f"points, whose coordinates are not finite, and {unknown} observations of unknown "
            "features. Export it again if these matter.",
            stacklevel=4,
        )
    return model.replace(
        points_world=torch.from_numpy(xyz[finite]),
        observation_point=torch.from_numpy(point[valid]),
        observation_view=torch.from_numpy(view[valid]),
        observation_pixels=torch.from_numpy(pixels[index[valid]]),
    )
