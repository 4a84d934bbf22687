"""Meshroom and AliceVision: ``cameras.sfm``, and any other SfMData in JSON."""

from pathlib import Path, PureWindowsPath
from typing import Unpack

from pimper_torch.camera_files.layout import expect, first_of, inside
from pimper_torch.camera_files.meshroom_sfm import KIND, read_meshroom_cameras
from pimper_torch.evidence.datasets.posed import (
    PosedOptions,
    PosedPhotograph,
    assemble,
    mask_finder,
)
from pimper_torch.records import Capture

_FILES = ("cameras.sfm", "sfm.json", "sfm.sfm", "cameras.json")


def read_meshroom(
    folder: Path | str,
    *,
    images: Path | str | None = None,
    masks: Path | str | None = None,
    **options: Unpack[PosedOptions],
) -> Capture:
    """Read the cameras of Meshroom's ``cameras.sfm`` and the photographs it names.

    Their meaning is that of
    :func:`~pimper_torch.camera_files.meshroom_sfm.read_meshroom_cameras`.

    Args:
        folder: With ``cameras.sfm`` or ``sfm.json``; or the file itself.
        images: Folder of the photographs, which are looked up by file name: the paths in the
            file are those of the machine that wrote it. By default ``images`` beside the file,
            or the file's own folder.
        masks: Folder of masks, if there are any.
        options: See :class:`~pimper_torch.evidence.datasets.posed.PosedOptions`.

    Raises:
        InputError: The file has another structure or describes a lens or rig that cannot be
            read, or a photograph is missing or damaged.
    """
    given = Path(folder)
    path = given if given.is_file() else first_of([given / name for name in _FILES])
    expect(path is not None, given, KIND, f"a file {' or '.join(_FILES[:2])}")
    assert path is not None
    cameras = read_meshroom_cameras(path)
    picture_folder = Path(images) if images else first_of([path.parent / "images", path.parent])
    assert picture_folder is not None
    mask_of = mask_finder(Path(masks) if masks else None, KIND)
    photographs = []
    for camera in cameras:
        name = PureWindowsPath(camera.name).name
        image = inside(picture_folder, name, KIND)
        photographs.append(
            PosedPhotograph(
                name=name,
                image=image,
                mask=mask_of(image),
                lens=camera.lens,
                cam_from_world=camera.cam_from_world,
            )
        )
    return assemble(photographs, path, KIND, **options)
