"""NeRF's ``transforms.json``, of Blender, instant-ngp and nerfstudio; read and written."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.camera_files.layout import expect, first_of, inside
from pimper_torch.camera_files.transforms_json import (
    FLIP,
    KIND,
    frame_camera,
    read_frames,
    stated_size,
)
from pimper_torch.evidence.datasets.pictures import (
    file_names,
    refuse_skew,
    write_mask,
    write_picture,
)
from pimper_torch.evidence.datasets.posed import PosedOptions, PosedPhotograph, assemble
from pimper_torch.geometry.frames import invert_rigid
from pimper_torch.io.decode import SUFFIXES, read_header
from pimper_torch.io.meshes import write_ply
from pimper_torch.records import Cameras, Capture, Mesh, Views

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


def write_transforms(
    views: Views,
    cameras: Cameras,
    folder: Path | str,
    *,
    points_world: Float[Tensor, "point 3"] | None = None,
) -> None:
    """Write ``transforms.json`` as nerfstudio reads it, with ``images/`` and ``masks/``.

    Intrinsics that all views share stand once in the file, where instant-ngp looks for them.

    Args:
        views: Undistorted.
        folder: Made if it is not there.
        points_world: A cloud, written as ``sparse_pc.ply`` and named in the file.

    Raises:
        InputError: A camera has a skew, which the format cannot represent.
    """
    folder = Path(folder)
    refuse_skew(cameras, views.names, "transforms.json")
    files = file_names(views.names)
    world_from_cam = invert_rigid(cameras.cam_from_world.detach().cpu().double()).clone()
    world_from_cam[:, :3, :3] *= FLIP
    lenses, frames = [], []
    for index, file in enumerate(files):
        write_picture(views, index, folder / "images" / file)
        frame: dict[str, object] = {"file_path": f"images/{file}"}
        if views.masks is not None:
            write_mask(views, index, folder / "masks" / file)
            frame["mask_path"] = f"masks/{file}"
        frame["transform_matrix"] = world_from_cam[index].tolist()
        frames.append(frame)
        lenses.append(_said(cameras, index))
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    if not shared:
        frames = [{**lens, **frame} for lens, frame in zip(lenses, frames, strict=True)]
    whole: dict[str, object] = {"camera_model": "PINHOLE", **shared}
    if points_world is not None:
        whole["ply_file_path"] = "sparse_pc.ply"
        faces = torch.zeros(0, 3, dtype=torch.long)
        write_ply(Mesh(vertices_world=points_world, faces=faces), folder / "sparse_pc.ply")
    text = json.dumps({**whole, "frames": frames}, indent=2, allow_nan=False, ensure_ascii=False)
    (folder / "transforms.json").write_text(text + "\n", encoding="utf-8")


def _said(cameras: Cameras, index: int) -> dict[str, float | int]:
    """Put a pinhole in the words of the format."""
    K = cameras.intrinsics[index].detach().cpu().double()
    width, height = (int(side) for side in cameras.sizes_px[index])
    return {
        "w": width,
        "h": height,
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
    }


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
