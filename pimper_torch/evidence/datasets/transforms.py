"""NeRF's ``transforms.json``, of Blender, instant-ngp and nerfstudio."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Unpack

from pimper_torch.camera_files.layout import expect, first_of, inside
from pimper_torch.camera_files.transforms_json import (
    KIND,
    frame_camera,
    read_frames,
    stated_size,
)
from pimper_torch.evidence.datasets.posed import PosedOptions, PosedPhotograph, assemble
from pimper_torch.io.decode import SUFFIXES, read_header
from pimper_torch.records import Capture

_FILES = ("transforms.json", "transforms_train.json")


def read_transforms(
    folder: Path | str,
    **options: Unpack[PosedOptions],
) -> Capture:
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
    given = Path(folder)
    path = given if given.is_file() else first_of([given / name for name in _FILES])
    expect(path is not None, given, KIND, f"a file {' or '.join(_FILES)}")
    assert path is not None
    frames = read_frames(path)
    images = [_image(frame, path) for frame in frames]
    photographs = [
        _photograph(frame, image, name, path)
        for frame, image, name in zip(frames, images, _names(images, path), strict=True)
    ]
    return assemble(photographs, path, KIND, **options)


def _image(frame: Mapping[str, object], path: Path) -> Path:
    """Find the file of a frame, whose suffix may be left out."""
    image = inside(path.parent, str(frame["file_path"]).replace("\\", "/"), KIND)
    if image.suffix.lower() in SUFFIXES:
        return image
    tried = [image.with_name(image.name + suffix) for suffix in (".png", *SUFFIXES)]
    return first_of(tried) or tried[0]


def _names(images: Sequence[Path], path: Path) -> list[str]:
    short = [image.name for image in images]
    if len(set(short)) == len(short):
        return short
    return [PurePosixPath(image.relative_to(path.parent)).as_posix() for image in images]


def _photograph(frame: Mapping[str, object], image: Path, name: str, path: Path) -> PosedPhotograph:
    size = stated_size(frame)
    if size is None:
        expect(image.is_file(), path, KIND, f"the photograph {image.name}", "no such file")
        header = read_header(image)
        size = header.width, header.height
    camera = frame_camera(frame, name, size, path)
    mask = frame.get("mask_path")
    return PosedPhotograph(
        name=name,
        image=image,
        mask=inside(path.parent, str(mask), KIND) if mask else None,
        lens=camera.lens,
        cam_from_world=camera.cam_from_world,
    )
