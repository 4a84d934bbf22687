"""Cameras of a file in any supported format."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pimper_torch.io.cameras.camera_arrays import read_camera_arrays
from pimper_torch.io.cameras.meshroom_sfm import read_meshroom_cameras
from pimper_torch.io.cameras.metashape_xml import read_metashape_cameras
from pimper_torch.io.cameras.posed_camera import PosedCamera, SizesOf
from pimper_torch.io.cameras.transforms_json import has_frames, read_transforms_cameras
from pimper_torch.runtime.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFormat:
    """A format of camera files.

    Attributes:
        name: Usual name of such a file.
        program: Programs that write it, or its content.
        suffixes: Suffixes of its files, in lower case.
        read: Reads a file. Its arguments are the path; the names of the photographs, for cameras
            assigned by their order; and a function that returns sizes, for cameras without a size.
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
"""All formats; a file is read by the first format that owns it."""


def read_cameras(path: Path, photographs: Sequence[str], sizes_of: SizesOf) -> list[PosedCamera]:
    """Read the cameras of a file in one of :data:`FORMATS`.

    Args:
        photographs: Names of the photographs, for cameras assigned by their order.
        sizes_of: Sizes of the photographs that a file names, for cameras without a size.

    Raises:
        InputError: The file has none of these formats, or is invalid.
    """
    suffix = path.suffix.lower()
    for each in FORMATS:
        if suffix in each.suffixes and each.owns(path):
            return each.read(path, photographs, sizes_of)
    supported = ", ".join(f"{each.name} ({each.program})" for each in FORMATS)
    raise InputError(
        f"{path}: is not a camera file; needed: the folder of a COLMAP model, or a file in one "
        f"of these formats: {supported}."
    )
