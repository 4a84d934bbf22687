"""COLMAP's model files, text and binary, as they stand: counts are checked before memory is taken.

The format is that of COLMAP's ``scene/reconstruction_io_*.cc``. What rigs and frames add is left
out: ``images`` holds every pose, too.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError, caution, some
from pimper_torch.geometry.frames import rigid
from pimper_torch.ledger import leave_out
from pimper_torch.records import Lens
from pimper_torch.sfm.model import SparseModel

Parsed = TypeVar("Parsed")

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
_MAX_NAME = 4096  # bytes, the longest path of Linux
_POINT2D = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_AGAIN = (
    "Write it again with COLMAP's model_converter, or leave it out to run structure from motion"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class FileImage:
    """An image as its file has it.

    Attributes:
        quaternion: Of ``cam_from_world``, real part first.
        pixels: Of its features, ``feature 2``. Which points they see, tracks tell.
    """

    image: int
    quaternion: tuple[int | float, ...]
    translation: tuple[int | float, ...]
    camera: int
    name: str
    pixels: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True)
class FilePoints:
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


@dataclass(frozen=True, slots=True, kw_only=True)
class FileModel:
    """The three files of a model."""

    cameras: tuple[Lens, ...]  # any number may be nonsense
    images: tuple[FileImage, ...]
    points: FilePoints


def read_files(folder: Path) -> FileModel:
    """Read ``cameras``, ``images`` and ``points3D``, all ``.bin`` or all ``.txt``.

    Raises:
        InputError: The folder holds no such files; or one is cut short, says that it holds more
            than it has room for, or is of another format.
    """
    ending = _ending(folder)
    if ending is None:
        raise InputError(
            f"{folder} holds no COLMAP model: needed are cameras, images and points3D, all .bin "
            "or all .txt. Point to the folder that has them, often named sparse/0."
        )
    cameras, images, points = _PARSERS[ending]
    return FileModel(
        cameras=_read(folder / f"cameras{ending}", cameras, folder),
        images=_read(folder / f"images{ending}", images, folder),
        points=_read(folder / f"points3D{ending}", points, folder),
    )


def names_by_folder(folder: Path) -> dict[Path, list[str]]:
    """Read the names of images of the models in folders of a folder that holds none itself.

    Raises:
        InputError: A file of images cannot be read.
    """
    folders = sorted(folder.iterdir()) if folder.is_dir() and not _ending(folder) else []
    endings = {path: ending for path in folders if (ending := _ending(path))}
    return {
        path: [image.name for image in _read(path / f"images{ending}", _PARSERS[ending][1], path)]
        for path, ending in endings.items()
    }


def _ending(folder: Path) -> str | None:
    """Find how the three files of a model end; ``None`` where one is missing."""
    for ending in _PARSERS:
        if all((folder / f"{part}{ending}").is_file() for part in _PARTS):
            return ending
    return None


class _Broken(Exception):  # noqa: N818 - what is broken, to be told with the name of the file
    """Why a file cannot be read."""


def _read(path: Path, parse: Callable[[bytes], Parsed], folder: Path) -> Parsed:
    try:
        return parse(path.read_bytes())
    except OSError as error:
        why = error.strerror or "the system refuses"
    except _Broken as error:
        why = str(error)
    raise InputError(f"The COLMAP model in {folder} cannot be read: {path.name} {why}. {_AGAIN}.")


class _Bytes:
    """A file's bytes, read from the front; never beyond its end."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def take(self, layout: str) -> tuple[int | float, ...]:
        size = struct.calcsize(layout)
        self.require(size)
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += size
        return values

    def require(self, size: int) -> None:
        if size > len(self.data) - self.at:
            raise _Broken(f"is cut short: it ends after {len(self.data)} bytes")

    def count(self, what: str, smallest: int) -> int:
        (number,) = self.take("<Q")
        if number * smallest > len(self.data) - self.at:
            raise _Broken(
                f"says that it holds {number} {what}, but has only {len(self.data)} bytes"
            )
        return int(number)

    def array(self, kind: np.dtype, count: int) -> np.ndarray:
        array = np.frombuffer(self.data, kind, count, self.at)
        self.at += count * kind.itemsize
        return array

    def name(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + _MAX_NAME)
        if end < 0:
            raise _Broken(f"has a name without an end within {_MAX_NAME} bytes")
        text = self.data[self.at : end].decode("utf-8", "surrogateescape")
        self.at = end + 1
        return text


def _binary_cameras(data: bytes) -> tuple[Lens, ...]:
    file = _Bytes(data)
    cameras = []
    for _ in range(file.count("cameras", 48)):
        camera, kind, width, height = file.take("<IiQQ")
        if not 0 <= kind < len(CAMERA_MODELS):
            raise _Broken(f"has a camera of the unknown model {int(kind)}")
        model, params = CAMERA_MODELS[int(kind)]
        values, size = file.take(f"<{params}d"), {"width": int(width), "height": int(height)}
        cameras.append(Lens(camera=int(camera), model=model, params=values, **size))
    return tuple(cameras)


def _binary_images(data: bytes) -> tuple[FileImage, ...]:
    file = _Bytes(data)
    images = []
    for _ in range(file.count("images", 73)):
        image, *pose, camera = file.take("<I7dI")
        name = file.name()
        features = file.array(_POINT2D, file.count("features of an image", _POINT2D.itemsize))
        images.append(
            FileImage(
                image=int(image),
                quaternion=tuple(pose[:4]),
                translation=tuple(pose[4:]),
                camera=int(camera),
                name=name,
                pixels=np.stack([features["x"], features["y"]], axis=1),
            )
        )
    return tuple(images)


def _binary_points(data: bytes) -> FilePoints:
    file = _Bytes(data)
    count = file.count("points", 51)
    ids, xyz = np.empty(count, np.uint64), np.empty((count, 3))
    lengths, tracks = np.empty(count, np.int64), []
    pair = np.dtype([("image", "<u4"), ("feature", "<u4")])
    head, size = struct.Struct("<Q3d3BdQ"), len(data)
    for index in range(count):
        if file.at + head.size > size:
            file.require(head.size)
        point, x, y, z, _, _, _, _, length = head.unpack_from(data, file.at)
        file.at += head.size
        if length * pair.itemsize > size - file.at:
            raise _Broken(
                f"says that {length} features see a point, but has only {size} bytes in all"
            )
        ids[index], xyz[index], lengths[index] = point, (x, y, z), length
        tracks.append(data[file.at : file.at + length * pair.itemsize])
        file.at += length * pair.itemsize
    track = np.frombuffer(b"".join(tracks), pair)
    return FilePoints(
        points=ids.astype(np.int64),
        xyz=xyz,
        track_point=np.repeat(np.arange(count), lengths),
        track_image=track["image"].astype(np.int64),
        track_feature=track["feature"].astype(np.int64),
    )


def _lines(data: bytes) -> Iterator[tuple[int, str]]:
    """Return the lines that are no comments, and their numbers; empty ones too."""
    text = data.decode("utf-8-sig", "surrogateescape")
    lines = text.removesuffix("\n").split("\n")  # a name may hold what else Unicode ends lines by
    for number, line in enumerate(lines, start=1):
        if not line.lstrip().startswith("#"):
            yield number, line.strip()


def _numbers(words: list[str], kind: type, number: int) -> list[float]:
    try:
        return [kind(word) for word in words]
    except (ValueError, OverflowError):
        shown = " ".join(words)[:60]
        raise _Broken(f"has in line {number} no numbers: {shown!r}") from None


def _whole(word: str, number: int) -> int:
    value = int(_numbers([word], int, number)[0])
    if not -(2**63) <= value < 2**63:
        raise _Broken(f"has in line {number} the number {word[:30]}, which none of COLMAP's is")
    return value


def _text_cameras(data: bytes) -> tuple[Lens, ...]:
    cameras = []
    for number, line in _lines(data):
        words = line.split()
        if not words:
            continue
        if len(words) < 5 or words[1] not in _PARAMS:
            raise _Broken(f"has in line {number} no camera: {line[:60]!r}")
        params = tuple(_numbers(words[4:], float, number))
        if len(params) != _PARAMS[words[1]]:
            needed = f"{_PARAMS[words[1]]} for {words[1]}"
            raise _Broken(f"has in line {number} {len(params)} parameters; needed: {needed}")
        camera, width, height = (_whole(words[at], number) for at in (0, 2, 3))
        cameras.append(
            Lens(camera=camera, model=words[1], width=width, height=height, params=params)
        )
    return tuple(cameras)


def _text_images(data: bytes) -> tuple[FileImage, ...]:
    images = []
    lines = _lines(data)
    for number, line in lines:
        if not line:
            continue
        words = line.split(maxsplit=9)  # a name may have spaces
        if len(words) < 10:
            raise _Broken(f"has in line {number} no image: {line[:60]!r}")
        pose = _numbers(words[1:8], float, number)
        below, features = next(lines, (number, ""))
        columns = features.split()
        if len(columns) % 3:
            raise _Broken(
                f"has in line {below} {len(columns)} numbers; needed: three for each feature"
            )
        xy = np.array(_numbers(columns, float, below), dtype=np.float64).reshape(-1, 3)
        images.append(
            FileImage(
                image=_whole(words[0], number),
                quaternion=tuple(pose[:4]),
                translation=tuple(pose[4:]),
                camera=_whole(words[8], number),
                name=words[9],
                pixels=xy[:, :2].copy(),
            )
        )
    return tuple(images)


def _text_points(data: bytes) -> FilePoints:
    points, xyz, lengths, tracks = [], [], [], []
    for number, line in _lines(data):
        words = line.split()
        if not words:
            continue
        if len(words) < 8 or len(words) % 2:
            raise _Broken(f"has in line {number} no point: {line[:60]!r}")
        points.append(_whole(words[0], number))
        xyz.append(_numbers(words[1:4], float, number))
        track = [_whole(word, number) for word in words[8:]]
        lengths.append(len(track) // 2)
        tracks += track
    pairs = np.array(tracks, dtype=np.int64).reshape(-1, 2)
    return FilePoints(
        points=np.array(points, dtype=np.int64),
        xyz=np.array(xyz, dtype=np.float64).reshape(-1, 3),
        track_point=np.repeat(np.arange(len(points)), lengths),
        track_image=pairs[:, 0],
        track_feature=pairs[:, 1],
    )


_PARTS = ("cameras", "images", "points3D")
_PARSERS = {
    ".bin": (_binary_cameras, _binary_images, _binary_points),
    ".txt": (_text_cameras, _text_images, _text_points),
}


# Choices: a model of which more is broken is not believed; no photograph is wider or higher.
_MAX_BROKEN, _MAX_SIDE = 0.5, 10**6
# COLMAP writes quaternions of length 1; other programs round them. Poses and points beyond
# this leave the range of single precision.
_UNIT, _MAX_COORDINATE = 0.1, 1e30


def sound_model(files: FileModel, folder: Path) -> SparseModel:
    """Keep what is sound, warn of the rest with its count; views and points by their numbers.

    Broken are cameras whose parameters are not finite or whose focal length is not above 0; images
    of these, with a pose that is not finite or a quaternion that is none, or that stand twice;
    points that are not finite; and observations that name an image or a feature that is not
    there.

    Raises:
        InputError: More than half of the images or points are broken: says why.
    """
    lenses = {one.camera: one for one in files.cameras if _camera_fault(one) == ""}
    kept, faults, seen = [], dict[str, list[str]](), set[object]()
    for image in sorted(files.images, key=lambda one: one.image):
        fault = _image_fault(image, files, lenses)
        if not fault and not seen.isdisjoint({image.image, image.name}):
            fault = "stand in it twice"
        if fault:
            faults.setdefault(fault, []).append(image.name)
        else:
            kept.append(image)
            seen |= {image.image, image.name}
    points, order = files.points, np.argsort(files.points.points, kind="stable")
    finite = (np.abs(points.xyz) < _MAX_COORDINATE).all(axis=1)
    dropped = [
        f"{len(names)} of {len(files.images)} images ({some(names, 4)}), which {fault}"
        for fault, names in faults.items()
    ]
    nowhere = int((~finite).sum())
    broken = [name for names in faults.values() for name in names]
    leave_out("sfm.broken_images", len(broken), total=len(files.images), names=broken)
    leave_out("sfm.broken_points", nowhere, total=len(finite))
    if nowhere:
        dropped.append(f"{nowhere} of {len(finite)} points, whose coordinates are not finite")
    broken_images = len(files.images) - len(kept) > _MAX_BROKEN * len(files.images)
    if broken_images or nowhere > _MAX_BROKEN * len(finite):
        raise InputError(
            f"The COLMAP model in {folder} is broken: unusable are {'; '.join(dropped)}. Needed: a "
            "model of which at least half is sound. Write it again, or leave it out to run "
            "structure from motion."
        )
    used = order[finite[order]]
    new_point = np.full(len(finite), -1)
    new_point[used] = np.arange(len(used))
    observations, lost = _observations(files, kept, new_point)
    if lost:
        total = int((new_point[points.track_point] >= 0).sum())
        dropped.append(f"{lost} of {total} observations, which name no feature of an image")
    if dropped:
        caution(
            f"The COLMAP model in {folder} is partly broken. Left out are {'; '.join(dropped)}. "
            "Write it again if these matter."
        )
    point, view, pixels = observations
    return SparseModel(
        names=tuple(image.name for image in kept),
        lenses=tuple(lenses[image.camera] for image in kept),
        cam_from_world=torch.stack([_pose(image) for image in kept])
        if kept
        else torch.zeros(0, 4, 4, dtype=torch.float64),
        points_world=torch.from_numpy(points.xyz[used]),
        observation_point=torch.from_numpy(point),
        observation_view=torch.from_numpy(view),
        observation_pixels=torch.from_numpy(pixels),
    )


def _camera_fault(camera: Lens) -> str:
    if camera.model == "EQUIRECTANGULAR":
        return "have a camera without a focal length, EQUIRECTANGULAR"
    if not all(0 < side <= _MAX_SIDE for side in (camera.width, camera.height)):
        return f"are {camera.width} x {camera.height} pixels large by their camera"
    if not all(abs(value) < _MAX_COORDINATE for value in camera.params):
        return "have a camera whose parameters are not finite"
    one = camera.model.startswith(("SIMPLE", "RADIAL"))  # focal length for both axes
    positive = min(camera.params[: 1 if one else 2]) > 0
    return "" if positive else "have a camera whose focal length is not above 0"


def _image_fault(image: FileImage, files: FileModel, lenses: dict[int, Lens]) -> str:
    length = float(np.linalg.norm(image.quaternion))
    if not abs(length - 1) <= _UNIT:
        return "have a pose whose quaternion is not of length 1"
    if not all(abs(value) < _MAX_COORDINATE for value in image.translation):
        return "have a pose that is not finite"
    if image.camera in lenses:
        return ""
    broken = [one for one in files.cameras if one.camera == image.camera]
    return _camera_fault(broken[0]) if broken else "have no camera"


def _pose(image: FileImage) -> Float[Tensor, "4 4"]:
    """Turn a quaternion, real part first, into a rotation."""
    quaternion = torch.tensor(image.quaternion, dtype=torch.float64)
    w, x, y, z = (quaternion / quaternion.norm()).tolist()
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return rigid(
        torch.tensor(rotation, dtype=torch.float64),
        torch.tensor(image.translation, dtype=torch.float64),
    )


def _observations(
    files: FileModel, kept: list[FileImage], new_point: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], int]:
    """Return point, view and pixel of each sound observation by rising point; count the others.

    Observations of what was dropped are not counted.
    """
    track = files.points
    view_of = {image.image: view for view, image in enumerate(kept)}
    dropped = [image.image for image in files.images if image.image not in view_of]
    view = np.array([view_of.get(image, -1) for image in track.track_image.tolist()], np.int64)
    starts = np.cumsum([0, *(len(image.pixels) for image in kept)])
    pixels = np.concatenate([np.zeros((0, 2)), *(image.pixels for image in kept)])
    point = new_point[track.track_point]
    seen = (point >= 0) & ~np.isin(track.track_image, dropped)
    there = (view >= 0) & (track.track_feature >= 0)
    there &= track.track_feature < np.append(np.diff(starts), 0)[view]
    feature = starts[view[there]] + track.track_feature[there]
    sound = seen & there
    sound[there] &= (np.abs(pixels[feature]) < _MAX_COORDINATE).all(axis=1)
    chosen = np.flatnonzero(sound)
    chosen = chosen[np.argsort(point[chosen], kind="stable")]
    found = pixels[starts[view[chosen]] + track.track_feature[chosen]]
    return (point[chosen], view[chosen], found), int((seen & ~sound).sum())
