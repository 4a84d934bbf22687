"""NeRF's ``transforms.json``, of Blender, instant-ngp and nerfstudio; read and written."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.evidence.datasets.layout import (
    expect,
    first_of,
    inside,
    numbers,
    objects,
    read_json,
)
from pimper_torch.evidence.datasets.pictures import (
    file_names,
    refuse_skew,
    write_mask,
    write_picture,
)
from pimper_torch.evidence.datasets.posed import PosedPhotograph, assemble, rigid_or_refuse
from pimper_torch.geometry.frames import invert_rigid
from pimper_torch.io.decode import SUFFIXES, read_header
from pimper_torch.io.meshes import write_ply
from pimper_torch.radiometry import FROM_FILES, Encoding
from pimper_torch.records import Cameras, Capture, Lens, Mesh, Views

_KIND = "a transforms.json set"
_FILES = ("transforms.json", "transforms_train.json")
_POLYNOMIAL = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
# OpenGL's camera has y up and looks along -z.
_FLIP = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)


def read_transforms(
    folder: Path | str,
    *,
    names: Sequence[str] | None = None,
    mesh: Path | str | None = None,
    encoding: Encoding = FROM_FILES,
    max_size_px: int = 0,
) -> Capture:
    """Read the cameras of a ``transforms.json`` and the photographs it names.

    ``transform_matrix`` is ``world_from_cam`` with OpenGL's camera axes (right, up, back).
    The focal length is ``fl_x``, ``fl_y`` in pixels, or follows from ``camera_angle_x``; the
    principal point ``cx``, ``cy`` is the centre of the image unless given. All of these, and
    ``w``, ``h``, ``k1`` to ``k4``, ``p1``, ``p2`` and ``camera_model``, may stand in the file
    or in a frame. instant-ngp and nerfstudio take them from COLMAP and cast rays through
    x + 0.5 (nerfstudio, "Data conventions" and ``Cameras.get_image_coords``), and Blender's
    centre is that of the image's area: their pixels are ours. Lenses are undistorted.

    The mask is ``mask_path`` where a frame has one, else the image's alpha channel.

    Args:
        folder: With ``transforms.json`` or ``transforms_train.json``; or a file of that kind.
        names: Keep these photographs, in this order. They are called as their files, or by
            their whole paths in the file where that is not unique.
        mesh: File of the true surface, if it is known.
        encoding: Response, saturation and black level of the files.
        max_size_px: Shrink larger photographs; the cameras follow. 0 leaves them.

    Raises:
        InputError: The file has another structure, or a photograph is missing or damaged.
    """
    given = Path(folder)
    path = given if given.is_file() else first_of([given / name for name in _FILES])
    expect(path is not None, given, _KIND, f"a file {' or '.join(_FILES)}")
    assert path is not None
    whole = read_json(path, _KIND)
    frames = objects(whole.get("frames"), "frames", path, _KIND)
    images = [_image(frame, path) for frame in frames]
    photographs = [
        _photograph({**whole, **frame}, image, name, path)
        for frame, image, name in zip(frames, images, _names(images, path), strict=True)
    ]
    return assemble(
        photographs, path, _KIND, names=names, mesh=mesh, encoding=encoding, max_size_px=max_size_px
    )


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
        cameras: One a view.
        folder: Made if it is not there.
        points_world: A cloud, written as ``sparse_pc.ply`` and named in the file.

    Raises:
        InputError: A camera has a skew, which the format cannot represent.
    """
    folder = Path(folder)
    refuse_skew(cameras, views.names, "transforms.json")
    files = file_names(views.names)
    world_from_cam = invert_rigid(cameras.cam_from_world.detach().cpu().double()).clone()
    world_from_cam[:, :3, :3] *= _FLIP
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
    name = frame.get("file_path")
    expect(isinstance(name, str) and name != "", path, _KIND, "a text as file_path", repr(name))
    image = inside(path.parent, str(name).replace("\\", "/"), _KIND)
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
    matrix = frame.get("transform_matrix")
    expect(
        isinstance(matrix, list) and len(matrix) in (3, 4),
        path,
        _KIND,
        f"4 rows of 4 numbers as transform_matrix of {name}",
        type(matrix).__name__,
    )
    rows = matrix[:3] if isinstance(matrix, list) else []
    world_from_cam = numbers(rows, 12, f"transform_matrix of {name}", path, _KIND).reshape(3, 4)
    pose = rigid_or_refuse(
        world_from_cam[:, :3] * _FLIP,
        world_from_cam[:, 3],
        f"transform_matrix of {name}",
        path,
        _KIND,
    )
    mask = frame.get("mask_path")
    return PosedPhotograph(
        name=name,
        image=image,
        mask=inside(path.parent, str(mask), _KIND) if mask else None,
        lens=_lens(frame, image, name, path),
        cam_from_world=invert_rigid(pose),
    )


def _lens(frame: Mapping[str, object], image: Path, name: str, path: Path) -> Lens:
    def value(key: str, default: float = 0.0) -> float:
        given = frame.get(key)
        if given is None:
            return default
        return float(numbers(given, 1, f"{key} of {name}", path, _KIND))

    if "w" in frame and "h" in frame:
        width, height = value("w"), value("h")
    else:
        expect(image.is_file(), path, _KIND, f"the photograph {image.name}", "no such file")
        header = read_header(image)
        width, height = float(header.width), float(header.height)
    focal = _focal(value("fl_x"), value("camera_angle_x"), width)
    focal_y = _focal(value("fl_y"), value("camera_angle_y"), height)
    expect(
        focal > 0 or focal_y > 0,
        path,
        _KIND,
        f"fl_x or camera_angle_x, in the file or for {name}",
        "neither, or no positive one",
    )
    fx, fy = focal or focal_y, focal_y or focal
    pinhole = (fx, fy, value("cx", width / 2), value("cy", height / 2))
    k1, k2, k3, k4, p1, p2 = (value(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = str(frame.get("camera_model") or "OPENCV")
    kind, params = "PINHOLE", tuple[float, ...]()
    if model == "OPENCV_FISHEYE" or frame.get("is_fisheye") is True:
        kind, params = "OPENCV_FISHEYE", (k1, k2, k3, k4)
    else:
        expect(model in _POLYNOMIAL, path, _KIND, f"a camera_model of {_POLYNOMIAL}", model)
        expect(k4 == 0, path, _KIND, f"k4 = 0 for {name}, unless it is a fisheye", f"{k4}")
        if any((k1, k2, k3, p1, p2)):
            kind, params = "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return Lens(
        camera=1, model=kind, params=(*pinhole, *params), width=round(width), height=round(height)
    )


def _focal(focal_px: float, angle: float, side_px: float) -> float:
    if focal_px > 0 or not 0 < angle < math.pi:
        return max(focal_px, 0.0)
    return side_px / 2 / math.tan(angle / 2)
