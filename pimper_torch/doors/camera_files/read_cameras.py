"""Cameras of a file, whichever program wrote it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pimper_torch.doors.camera_files.camera_arrays import read_camera_arrays
from pimper_torch.doors.camera_files.meshroom_sfm import read_meshroom_cameras
from pimper_torch.doors.camera_files.metashape_xml import read_metashape_cameras
from pimper_torch.doors.camera_files.posed_camera import PosedCamera, SizesOf
from pimper_torch.doors.camera_files.transforms_json import has_frames, read_transforms_cameras
from pimper_torch.runtime.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFormat:
    """A format of files of cameras.

    Attributes:
        name: What such a file is usually called.
        program: What writes it, or what it holds.
        suffixes: Of its files, in lower case.
        read: Reads a file. It is handed the path, the photographs' names, for cameras that go by
            the order of these, and a function that looks up sizes, for cameras without any.
        owns: Whether a file with one of the suffixes is of this format; by default all are.
    """

    name: str
    program: str
    suffixes: tuple[str, ...]
    read: Callable[[Path, Sequence[str], SizesOf], list[PosedCamera]]
    owns: Callable[[Path], bool] = lambda path: True


FORMATS = [
    CameraFormat(
        name="transforms.json",
        program="NeRF, instant-ngp, nerfstudio",
        suffixes=(".json",),
        read=lambda path, _, sizes_of: read_transforms_cameras(path, sizes_of),
        owns=has_frames,
    ),
    CameraFormat(
        name="cameras.xml",
        program="Metashape",
        suffixes=(".xml",),
        read=lambda path, *_: read_metashape_cameras(path),
    ),
    CameraFormat(
        name="cameras.sfm",
        program="Meshroom",
        suffixes=(".sfm", ".json"),
        read=lambda path, *_: read_meshroom_cameras(path),
    ),
    CameraFormat(name="cameras.npz", program="arrays", suffixes=(".npz",), read=read_camera_arrays),
]
"""All formats: the first one that owns a file reads it."""


def read_cameras(path: Path, photographs: Sequence[str], sizes_of: SizesOf) -> list[PosedCamera]:
    """Read the cameras of a file in one of :data:`FORMATS`.

    Args:
        photographs: Their names, for cameras that go by the order of these.
        sizes_of: Photographs that a file names, for cameras without a size.

    Raises:
        InputError: The file is of no such format, or its reader refuses it.
    """
    suffix = path.suffix.lower()
    for each in FORMATS:
        if suffix in each.suffixes and each.owns(path):
            return each.read(path, photographs, sizes_of)
    known = ", ".join(f"{each.name} ({each.program})" for each in FORMATS)
    raise InputError(
        f"{path}: is no file of cameras; needed: the folder of a COLMAP model, or a file of one "
        f"of these formats: {known}."
    )
