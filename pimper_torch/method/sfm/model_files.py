"""COLMAP's model files, text and binary, and the part of a model that is sound.

The format is that of COLMAP's ``scene/reconstruction_io_*.cc``. What rigs and frames add is left
out: ``images`` holds every pose, too. Files of strangers are read without COLMAP, whose reader ends
the process where they are broken.
"""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.geometry.rigid import rigid
from pimper_torch.method.sfm.model import SparseModel
from pimper_torch.records import Lens
from pimper_torch.runtime.errors import InputError, caution, some
from pimper_torch.runtime.ledger import leave_out

Parsed = TypeVar("Parsed")
Lines = Iterator[tuple[int, str]]

# COLMAP's camera models by their number in binary files, with how many parameters each has.
CAMERA_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)
_PARAMS = dict(CAMERA_MODELS)
_POINT2D = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_MAX_COORDINATE = 1e30  # poses and points beyond leave the range of single precision


class FileImage(NamedTuple):
    """An image as its file has it.

    Attributes:
        pose: ``cam_from_world``: a quaternion, real part first, then the translation.
        pixels: Of its features, ``feature 2``. Which points they see, tracks tell.
    """

    image: int
    pose: tuple[float, ...]
    camera: int
    name: str
    pixels: np.ndarray


class FilePoints(NamedTuple):
    """All points as their file has them.

    Attributes:
        track_point: Position in ``points`` of what each element of a track belongs to.
        track_feature: Position among the features of that image.
    """

    points: np.ndarray
    xyz: np.ndarray
    track_point: np.ndarray
    track_image: np.ndarray
    track_feature: np.ndarray


class FileModel(NamedTuple):
    """The three files of a model; any number may be nonsense."""

    cameras: tuple[Lens, ...]
    images: tuple[FileImage, ...]
    points: FilePoints


def read_files(folder: Path) -> FileModel:
    """Read ``cameras``, ``images`` and ``points3D``, all ``.bin`` or all ``.txt``.

    Raises:
        InputError: The folder holds no such files; or one is cut short, or of another format.
    """
    ending = _ending(folder)
    if ending is None:
        raise InputError(
            f"{folder} holds no COLMAP model: needed are cameras, images and points3D, all .bin "
            "or all .txt. Point to the folder that has them, often named sparse/0."
        )
    cameras, images, points = _PARSERS[ending]
    return FileModel(
        _read(folder / f"cameras{ending}", cameras, folder),
        _read(folder / f"images{ending}", images, folder),
        _read(folder / f"points3D{ending}", points, folder),
    )


def largest_model(folder: Path) -> Path:
    """Return a folder with a model, or the folder in it that has the largest; warn of others."""
    inner = sorted(folder.iterdir()) if folder.is_dir() and not _ending(folder) else []
    endings = {path: ending for path in inner if (ending := _ending(path))}
    sizes = {path: (path / f"images{ending}").stat().st_size for path, ending in endings.items()}
    largest = max(sizes, key=sizes.__getitem__, default=folder)
    if len(sizes) > 1:
        others = some([path.name for path in sizes if path != largest])
        caution(
            f"{folder} holds {len(sizes)} COLMAP models, each in a frame of its own; read is "
            f"{largest.name}, the largest, not {others}. Point to another one if that is meant."
        )
    return largest


def _ending(folder: Path) -> str | None:
    """Find how the three files of a model end; ``None`` where one is missing."""
    for ending in _PARSERS:
        names = (f"{part}{ending}" for part in ("cameras", "images", "points3D"))
        if all((folder / name).is_file() for name in names):
            return ending
    return None


def _read(path: Path, parse: Callable[[bytes], Parsed], folder: Path) -> Parsed:
    try:
        return parse(path.read_bytes())
    except OSError as error:
        why = error.strerror or "the system refuses"
    except _BadLineError as error:
        why = str(error)
    except (struct.error, ValueError, IndexError, OverflowError):
        why = "is cut short, or of another format"
    raise InputError(
        f"The COLMAP model in {folder} cannot be read: {path.name} {why}. Write it again with "
        "COLMAP's model_converter, or leave it out to run structure from motion."
    )


def _binary_cameras(data: bytes) -> tuple[Lens, ...]:
    (count,), at = struct.unpack_from("<Q", data), 8
    cameras = []
    for _ in range(count):
        camera, kind, width, height = struct.unpack_from("<IiQQ", data, at)
        model, size = CAMERA_MODELS[kind if kind >= 0 else len(CAMERA_MODELS)]
        params = struct.unpack_from(f"<{size}d", data, at + 24)
        cameras.append(Lens(camera=camera, model=model, params=params, width=width, height=height))
        at += 24 + 8 * size
    return tuple(cameras)


def _binary_images(data: bytes) -> tuple[FileImage, ...]:
    (count,), at = struct.unpack_from("<Q", data), 8
    images = []
    for _ in range(count):
        image, *pose, camera = struct.unpack_from("<I7dI", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8", "surrogateescape")
        (features,) = struct.unpack_from("<Q", data, end + 1)
        seen = np.frombuffer(data, _POINT2D, features, end + 9)
        pixels = np.stack([seen["x"], seen["y"]], axis=1)
        images.append(FileImage(image, tuple(pose), camera, name, pixels))
        at = end + 9 + seen.nbytes
    return tuple(images)


def _binary_points(data: bytes) -> FilePoints:
    (count,), at = struct.unpack_from("<Q", data), 8
    head, pair = struct.Struct("<Q3d3BdQ"), np.dtype([("image", "<u4"), ("feature", "<u4")])
    points, xyz, lengths, tracks = [], [], [], []
    for _ in range(count):
        point, *place, _, _, _, _, length = head.unpack_from(data, at)
        at += head.size + 8 * length
        if at > len(data):
            raise ValueError("a track beyond the end")
        points.append(point)
        xyz.append(place)
        lengths.append(length)
        tracks.append(data[at - 8 * length : at])
    track = np.frombuffer(b"".join(tracks), pair)
    return _points(points, xyz, lengths, np.stack([track["image"], track["feature"]], axis=1))


def _points(
    points: list[int], xyz: list[list[float]], lengths: list[int], track: np.ndarray
) -> FilePoints:
    return FilePoints(
        points=np.array(points, dtype=np.uint64).astype(np.int64),
        xyz=np.array(xyz, dtype=np.float64).reshape(-1, 3),
        track_point=np.repeat(np.arange(len(points)), lengths),
        track_image=track[:, 0].astype(np.int64),
        track_feature=track[:, 1].astype(np.int64),
    )


class _BadLineError(ValueError):
    """Why a line cannot be read."""


def _parsed(data: bytes, what: str, parse: Callable[[str, Lines], Parsed]) -> list[Parsed]:
    """Parse the lines of a text that are neither comments nor empty; one may take the next."""
    text = data.decode("utf-8-sig", "surrogateescape").removesuffix("\n")
    # A name may hold what else Unicode ends lines by.
    numbered = enumerate(text.split("\n"), start=1)
    lines = ((at, line.strip()) for at, line in numbered if not line.lstrip().startswith("#"))
    found = []
    for number, line in lines:
        try:
            found += [parse(line, lines)] if line else []
        except (ValueError, IndexError, KeyError):
            raise _BadLineError(f"has in line {number} no {what}: {line[:60]!r}") from None
    return found


def _text_cameras(data: bytes) -> tuple[Lens, ...]:
    def camera(line: str, _: Lines) -> Lens:
        number, model, width, height, *params = line.split()
        if len(params) != _PARAMS[model]:
            raise ValueError(f"{len(params)} parameters of {model}")
        values = tuple(map(float, params))
        size = {"width": int(width), "height": int(height)}
        return Lens(camera=int(number), model=model, params=values, **size)

    return tuple(_parsed(data, "camera", camera))


def _text_images(data: bytes) -> tuple[FileImage, ...]:
    def image(line: str, lines: Lines) -> FileImage:
        words = line.split(maxsplit=9)  # a name may have spaces
        features = [float(word) for word in next(lines, (0, ""))[1].split()]
        pixels = np.array(features, dtype=np.float64).reshape(-1, 3)[:, :2].copy()
        pose = tuple(map(float, words[1:8]))
        return FileImage(int(words[0]), pose, int(words[8]), words[9], pixels)

    return tuple(_parsed(data, "image", image))


def _text_points(data: bytes) -> FilePoints:
    def point(line: str, _lines: Lines) -> tuple[int, list[float], np.ndarray]:
        number, x, y, z, _, _, _, _, *track = line.split()
        ends = np.array([int(word) for word in track], dtype=np.int64).reshape(-1, 2)
        return int(number), [float(x), float(y), float(z)], ends

    rows = _parsed(data, "point", point)
    points, xyz, tracks = (list(part) for part in zip(*rows, strict=True)) if rows else ([], [], [])
    ends = np.concatenate([np.zeros((0, 2), np.int64), *tracks])
    return _points(points, xyz, list(map(len, tracks)), ends)


_PARSERS = {
    ".bin": (_binary_cameras, _binary_images, _binary_points),
    ".txt": (_text_cameras, _text_images, _text_points),
}


def sound_model(files: FileModel, folder: Path) -> SparseModel:
    """Take views and points by their numbers.

    Points that are not finite, and observations that name an image or a feature that is not there,
    are left out with a warning.

    Raises:
        InputError: An image stands in the model twice, or has a pose or a camera that is none; or
            most points are not finite.
    """
    lenses = {camera.camera: camera for camera in files.cameras}
    images = sorted(files.images, key=lambda image: image.image)
    faults = [f"{image.name} has {fault}" for image in images if (fault := _fault(image, lenses))]
    names = [image.name for image in images]
    faults += [f"{name} stands in it twice" for name in sorted(set(names)) if names.count(name) > 1]
    points, order = files.points, np.argsort(files.points.points, kind="stable")
    finite = (np.abs(points.xyz) < _MAX_COORDINATE).all(axis=1)
    nowhere = int((~finite).sum())
    if 2 * nowhere > len(finite):
        faults.append(f"{nowhere} of {len(finite)} points are not finite")
    if faults:
        raise InputError(
            f"The COLMAP model in {folder} is broken: {some(faults, 4)}. Write it again, or leave "
            "it out to run structure from motion."
        )
    used = order[finite[order]]
    new_point = np.full(len(finite), -1)
    new_point[used] = np.arange(len(used))
    point, view, pixels, lost = _observations(files.points, images, new_point)
    leave_out("sfm.broken_points", nowhere, total=len(finite))
    if nowhere or lost:
        caution(
            f"The COLMAP model in {folder} is partly broken. Left out are {nowhere} of "
            f"{len(finite)} points, whose coordinates are not finite, and {lost} observations, "
            "which name no feature of an image. Write it again if these matter."
        )
    return SparseModel(
        names=tuple(names),
        lenses=tuple(lenses[image.camera] for image in images),
        cam_from_world=torch.stack([torch.zeros(4, 4).double(), *map(_pose, images)])[1:],
        points_world=torch.from_numpy(points.xyz[used]),
        observation_point=torch.from_numpy(point),
        observation_view=torch.from_numpy(view),
        observation_pixels=torch.from_numpy(pixels),
    )


def _fault(image: FileImage, lenses: dict[int, Lens]) -> str:
    if not abs(float(np.linalg.norm(image.pose[:4])) - 1) <= 0.1:  # other programs round
        return "a pose whose quaternion is not of length 1"
    if not all(abs(value) < _MAX_COORDINATE for value in image.pose[4:]):
        return "a pose that is not finite"
    lens = lenses.get(image.camera)
    if lens is None:
        return "no camera"
    if not all(0 < side <= 10**6 for side in (lens.width, lens.height)):
        return f"a camera of {lens.width} x {lens.height} pixels"
    if not all(abs(value) < _MAX_COORDINATE for value in lens.params):
        return "a camera that is not finite"
    focals = lens.params[: 1 if lens.model.startswith(("SIMPLE", "RADIAL")) else 2]
    wrong = lens.model == "EQUIRECTANGULAR" or min(focals) <= 0
    return "a camera without a focal length above 0" if wrong else ""


def _pose(image: FileImage) -> Float[Tensor, "4 4"]:
    """Turn a quaternion, real part first, into a rotation."""
    quaternion = torch.tensor(image.pose[:4], dtype=torch.float64)
    w, x, y, z = (quaternion / quaternion.norm()).tolist()
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return rigid(
        torch.tensor(rotation, dtype=torch.float64),
        torch.tensor(image.pose[4:], dtype=torch.float64),
    )


def _observations(
    track: FilePoints, images: list[FileImage], new_point: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Return point, view and pixel of each sound observation by rising point; count the others."""
    view_of = {image.image: view for view, image in enumerate(images)}
    view = np.array([view_of.get(image, -1) for image in track.track_image.tolist()], np.int64)
    starts = np.cumsum([0, *(len(image.pixels) for image in images)])
    pixels = np.concatenate([np.zeros((0, 2)), *(image.pixels for image in images)])
    point = new_point[track.track_point]
    sound = (point >= 0) & (view >= 0) & (track.track_feature >= 0)
    sound &= track.track_feature < np.append(np.diff(starts), 0)[view]
    feature = starts[view[sound]] + track.track_feature[sound]
    sound[sound] = (np.abs(pixels[feature]) < _MAX_COORDINATE).all(axis=1)
    chosen = np.flatnonzero(sound)
    chosen = chosen[np.argsort(point[chosen], kind="stable")]
    found = pixels[starts[view[chosen]] + track.track_feature[chosen]]
    return point[chosen], view[chosen], found, int((point >= 0).sum()) - len(chosen)
