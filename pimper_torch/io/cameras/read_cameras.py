"""Cameras of a file in any supported format."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from pimper_torch.io.cameras.camera_arrays import read_camera_arrays
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.meshroom_sfm import read_meshroom
from pimper_torch.io.cameras.metashape_xml import read_metashape
from pimper_torch.io.cameras.phone_scans import read_polycam, read_record3d
from pimper_torch.io.cameras.posed_camera import PosedCamera, SizesOf
from pimper_torch.io.cameras.transforms_json import read_nerf
from pimper_torch.runtime.errors import InputError, shortened, some


class CameraFormat(NamedTuple):
    """A format of camera files.

    Attributes:
        name: Usual name of such a file.
        program: Programs that write it, or its content.
        suffixes: Suffixes of its files, in lower case.
        read: Reads a file. Its arguments are the path; the names of the photographs, for cameras
            assigned by their order; and a function that returns sizes, for cameras without a size.
        keys: Keys of JSON or columns of CSV that all of its files have, and by which they differ
            from those of other formats with the same suffix.
    """

    name: str
    program: str
    suffixes: tuple[str, ...]
    read: Callable[[Path, Sequence[str], SizesOf], list[PosedCamera]]
    keys: tuple[str, ...] = ()


FORMATS = [
    CameraFormat(
        "transforms.json", "NeRF, instant-ngp, nerfstudio", (".json",), read_nerf, ("frames",)
    ),
    CameraFormat("cameras.xml", "Metashape", (".xml",), read_metashape),
    CameraFormat("cameras.sfm", "Meshroom", (".sfm", ".json"), read_meshroom, ("version", "views")),
    CameraFormat("keyframes/corrected_cameras", "Polycam", (".json",), read_polycam, ("t_00",)),
    CameraFormat("metadata", "Record3D", ("", ".json"), read_record3d, ("K", "poses")),
    CameraFormat("cameras.npz", "arrays", (".npz",), read_camera_arrays),
]
"""All formats; a file is read by the first one that has its suffix and whose keys it has."""

# Files that are not read, by a key: how their program writes cameras that are.
_REMEDIES = {
    "sfm_data_version": "OpenMVG makes a COLMAP model by `openMVG_main_openMVG2Colmap`.",
    "shots": "OpenSfM makes a COLMAP model by `opensfm export_colmap DATASET`.",
    "#name": "RealityCapture exports COLMAP models, which define the signs that this lacks.",
}


def read_cameras(path: Path, photographs: Sequence[str], sizes_of: SizesOf) -> list[PosedCamera]:
    """Read the cameras of a file in one of :data:`FORMATS`.

    Args:
        photographs: Names of the photographs, for cameras assigned by their order.
        sizes_of: Sizes of the photographs that a file names, for cameras without a size.

    Raises:
        InputError: The file has none of these formats, or is invalid.
    """
    keys = _keys_of(path)
    for each in FORMATS:
        if path.suffix.lower() in each.suffixes and {*each.keys} <= {*keys}:
            return each.read(path, photographs, sizes_of)
    found = f", but has {shortened(some(keys))}" if keys else ""
    supported = ", ".join(f"{each.name} ({each.program})" for each in FORMATS)
    remedies = "".join(f" {text}" for key, text in _REMEDIES.items() if key in keys)
    raise InputError(
        f"{path}: is not a camera file{found}; needed: the folder of a COLMAP model, or a file in "
        f"one of these formats: {supported}.{remedies}"
    )


def _keys_of(path: Path) -> list[str]:
    """Return the keys of JSON, of a list those of its first entry, or the columns of CSV."""
    file, suffix = DataSetPath(path, "a camera file"), path.suffix.lower()
    if not path.is_file() or suffix not in ("", ".csv", ".json", ".sfm"):
        return []
    if suffix == ".csv":
        return [column.strip() for column in "".join(file.read_text().splitlines()[:1]).split(",")]
    content = file.read(lambda path: json.loads(path.read_text("utf-8-sig")), "JSON in UTF-8")
    entry = content[0] if isinstance(content, list) and content else content
    return list(entry) if isinstance(entry, dict) else []
