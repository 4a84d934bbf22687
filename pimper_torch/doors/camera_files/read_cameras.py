"""Cameras of a file, whichever program wrote it."""

from collections.abc import Sequence
from pathlib import Path

from pimper_torch.doors.camera_files.camera_arrays import read_camera_arrays
from pimper_torch.doors.camera_files.layout import DataSetPath
from pimper_torch.doors.camera_files.meshroom_sfm import read_meshroom_cameras
from pimper_torch.doors.camera_files.metashape_xml import read_metashape_cameras
from pimper_torch.doors.camera_files.posed_camera import PosedCamera, SizesOf
from pimper_torch.doors.camera_files.transforms_json import read_transforms_cameras
from pimper_torch.runtime.errors import InputError

_KIND = "a file of cameras"


def read_cameras(path: Path, photographs: Sequence[str], sizes_of: SizesOf) -> list[PosedCamera]:
    """Read the cameras of ``transforms.json``, Meshroom, Metashape, or NumPy's archives.

    Args:
        photographs: Their names, for cameras that go by the order of these.
        sizes_of: Photographs that a file names, for cameras without a size.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return read_camera_arrays(path, photographs, sizes_of)
    if suffix == ".xml":
        return read_metashape_cameras(path)
    if suffix in (".sfm", ".json"):
        framed = suffix == ".json" and "frames" in DataSetPath(path, _KIND).read_json()
        return read_transforms_cameras(path, sizes_of) if framed else read_meshroom_cameras(path)
    raise InputError(
        f"{path}: is no file of cameras; needed: the folder of a COLMAP model, or a file "
        "transforms.json, cameras.xml (Metashape), cameras.sfm (Meshroom) or cameras.npz (arrays)."
    )
