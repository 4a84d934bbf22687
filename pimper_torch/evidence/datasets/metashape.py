"""Agisoft Metashape (PhotoScan): the XML that "Export Cameras" writes."""

from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import Unpack

from pimper_torch.camera_files.layout import expect, first_of
from pimper_torch.camera_files.metashape_xml import KIND, read_metashape_cameras
from pimper_torch.errors import some
from pimper_torch.evidence.datasets.posed import (
    PosedOptions,
    PosedPhotograph,
    assemble,
    image_files,
    mask_finder,
)
from pimper_torch.records import Capture


def read_metashape(
    folder: Path | str,
    *,
    images: Path | str | None = None,
    masks: Path | str | None = None,
    **options: Unpack[PosedOptions],
) -> Capture:
    """Read the cameras that Metashape exported as XML, and their photographs.

    Their meaning is that of
    :func:`~pimper_torch.camera_files.metashape_xml.read_metashape_cameras`.

    Args:
        folder: With one ``.xml`` file; or the file itself.
        images: Folder of the photographs, which are called as the cameras are labelled, with
            or without suffix; by default ``images`` beside the file, or the file's own folder.
        masks: Folder of masks, if there are any.
        options: See :class:`~pimper_torch.evidence.datasets.posed.PosedOptions`. Names are
            those of files.

    Raises:
        InputError: The file is something else, defines entities, or describes a lens or rig
            that cannot be read; or a photograph is missing or damaged.
    """
    path = _xml_file(Path(folder))
    cameras = read_metashape_cameras(path)
    picture_folder = Path(images) if images else first_of([path.parent / "images", path.parent])
    assert picture_folder is not None
    files = image_files(picture_folder, KIND)
    mask_of = mask_finder(Path(masks) if masks else None, KIND)
    images_of = [_file_of(camera.name, files, picture_folder) for camera in cameras]
    photographs = [
        PosedPhotograph(
            name=image.name,
            image=image,
            mask=mask_of(image),
            lens=camera.lens,
            skew_px=camera.skew_px,
            cam_from_world=camera.cam_from_world,
        )
        for camera, image in zip(cameras, images_of, strict=True)
    ]
    return assemble(photographs, path, KIND, **options)


def _xml_file(given: Path) -> Path:
    if given.is_file():
        return given
    expect(given.is_dir(), given, KIND, "its file or folder")
    found = sorted(given.glob("*.xml"))
    expect(len(found) == 1, given, KIND, "one .xml file")
    return found[0]


def _file_of(label: str, files: Sequence[Path], folder: Path) -> Path:
    name = PureWindowsPath(label).name
    found = [path for path in files if path.name == name]
    found = found or [path for path in files if path.stem == name]
    found = found or [path for path in files if path.stem == PureWindowsPath(name).stem]
    expect(
        len(found) == 1,
        folder,
        KIND,
        f"one photograph called {name}",
        some([path.name for path in found or files]),
    )
    return found[0]
