"""Photographs beside cameras of Meshroom, Metashape, and NeRF's ``transforms.json``."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Unpack

from pimper_torch.camera_files import meshroom_sfm, metashape_xml, transforms_json
from pimper_torch.camera_files.layout import expect, file_in, first_of, inside
from pimper_torch.camera_files.posed_camera import PosedCamera
from pimper_torch.errors import some
from pimper_torch.evidence.datasets.posed import (
    PosedOptions,
    PosedPhotograph,
    assemble,
    image_files,
    mask_finder,
)
from pimper_torch.io.decode import SUFFIXES, read_header
from pimper_torch.records import Capture

_MESHROOM = ("cameras.sfm", "sfm.json", "sfm.sfm", "cameras.json")
_TRANSFORMS = ("transforms.json", "transforms_train.json")


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
        options: See :class:`~pimper_torch.evidence.datasets.posed.PosedOptions`.

    Raises:
        InputError: The file has another structure or describes a lens or rig that cannot be
            read, or a photograph is missing or damaged.
    """
    kind = meshroom_sfm.KIND
    path = file_in(folder, _MESHROOM, kind)

    def find(camera: PosedCamera, pictures: Path) -> Path:
        return inside(pictures, PureWindowsPath(camera.name).name, kind)

    cameras = meshroom_sfm.read_meshroom_cameras(path)
    return assemble(_beside(cameras, path, kind, images, masks, find), path, kind, **options)


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
            or without suffix; by default as of :func:`read_meshroom`.
        options: See :class:`~pimper_torch.evidence.datasets.posed.PosedOptions`. Names are
            those of files.

    Raises:
        InputError: The file is something else, defines entities, or describes a lens or rig
            that cannot be read; or a photograph is missing or damaged.
    """
    kind = metashape_xml.KIND
    path = file_in(folder, ("*.xml",), kind)

    def find(camera: PosedCamera, pictures: Path) -> Path:
        files, name = image_files(pictures, kind), PureWindowsPath(camera.name).name
        found = [path for path in files if path.name == name]
        found = found or [path for path in files if path.stem == name]
        found = found or [path for path in files if path.stem == PureWindowsPath(name).stem]
        told = some([path.name for path in found or files])
        expect(len(found) == 1, pictures, kind, f"one photograph called {name}", told)
        return found[0]

    cameras = metashape_xml.read_metashape_cameras(path)
    return assemble(_beside(cameras, path, kind, images, masks, find), path, kind, **options)


def _beside(
    cameras: Sequence[PosedCamera],
    path: Path,
    kind: str,
    images: Path | str | None,
    masks: Path | str | None,
    find: Callable[[PosedCamera, Path], Path],
) -> list[PosedPhotograph]:
    """Find the photographs of cameras in a folder, by default beside their file."""
    beside = path.parent / "images"
    pictures = Path(images) if images else beside if beside.exists() else path.parent
    mask_of = mask_finder(masks, kind)
    found = [(camera, find(camera, pictures)) for camera in cameras]
    return [PosedPhotograph.of(camera, image, mask_of(image)) for camera, image in found]


def read_transforms(folder: Path | str, **options: Unpack[PosedOptions]) -> Capture:
    """Read the cameras of a ``transforms.json`` and the photographs it names.

    Their meaning is that of
    :func:`~pimper_torch.camera_files.transforms_json.read_transforms_cameras`. Lenses are
    undistorted.

    The mask is ``mask_path`` where a frame has one, else the image's alpha channel.

    Args:
        folder: With ``transforms.json`` or ``transforms_train.json``; or a file of that kind.
        options: See :class:`~pimper_torch.evidence.datasets.posed.PosedOptions`. Names are those of
            files, or whole paths in the file where these are not unique.

    Raises:
        InputError: The file has another structure, or a photograph is missing or damaged.
    """
    kind = transforms_json.KIND
    path = file_in(folder, _TRANSFORMS, kind)
    frames = transforms_json.read_frames(path)
    images = [_image(frame, path) for frame in frames]
    names = [image.name for image in images]
    if len(set(names)) < len(names):
        names = [PurePosixPath(image.relative_to(path.parent)).as_posix() for image in images]
    photographs = []
    for frame, image, name in zip(frames, images, names, strict=True):
        size = transforms_json.stated_size(frame)
        if size is None:
            expect(image.is_file(), path, kind, f"the photograph {image.name}", "no such file")
            header = read_header(image)
            size = header.width, header.height
        camera = transforms_json.frame_camera(frame, name, size, path)
        drawn = frame.get("mask_path")
        mask = inside(path.parent, str(drawn), kind) if drawn else None
        photographs.append(PosedPhotograph.of(camera, image, mask, name))
    return assemble(photographs, path, kind, **options)


def _image(frame: Mapping[str, object], path: Path) -> Path:
    """Find the file of a frame, whose suffix may be left out."""
    name = str(frame["file_path"]).replace("\\", "/")
    image = inside(path.parent, name, transforms_json.KIND)
    if image.suffix.lower() in SUFFIXES:
        return image
    tried = [image.with_name(image.name + suffix) for suffix in (".png", *SUFFIXES)]
    return first_of(tried) or tried[0]
