"""Cameras of NeRF's ``transforms.json``, as written by Blender, instant-ngp and nerfstudio."""

import math
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path

import lazy_loader
import numpy as np
import torch

from pimper_torch.geometry.rigid import invert_rigid
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.posed_camera import PosedCamera, SizesOf, number_lenses, opencv_lens
from pimper_torch.records import CameraModel
from pimper_torch.records.shapes import Points
from pimper_torch.runtime.errors import InputError, caution

trimesh = lazy_loader.load("trimesh")  # takes a second
KIND = "a transforms.json set"
FLIP = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64, device="cpu")
"""Converts OpenGL's camera axes, with y up and the view along -z."""

_OPENCV = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")


def read_frames(path: Path) -> list[dict[str, object]]:
    """Return the frames, each with the values of the file for keys that it lacks."""
    file = DataSetPath(path, KIND)
    content = file.read_json()
    frames = [{**content, **frame} for frame in file.objects(content.get("frames"), "frames")]
    for frame in frames:
        name = frame.get("file_path")
        file.expect(isinstance(name, str) and name != "", "a text as file_path", repr(name))
    return frames


def read_nerf(path: Path, _: object, sizes_of: SizesOf) -> list[PosedCamera]:
    """Read the cameras; sizes that the file lacks are those of the photographs.

    ``transform_matrix`` is ``world_from_cam`` with OpenGL's camera axes (right, up, back).
    The focal length is ``fl_x``, ``fl_y`` in pixels, or follows from ``camera_angle_x``; the
    principal point ``cx``, ``cy`` is the centre of the image unless given. All of these, and
    ``w``, ``h``, ``k1`` to ``k6``, ``p1``, ``p2`` and ``camera_model``, may be in the file
    or in a frame. instant-ngp and nerfstudio use COLMAP's values and cast rays through
    x + 0.5 (nerfstudio, "Data conventions" and ``Cameras.get_image_coords``), and Blender's
    centre is that of the image's area: their pixel coordinates are ours.

    Args:
        sizes_of: Returns sizes of photographs by ``file_path``.

    Returns:
        In the order of the file; without frames of unknown size.
    """
    return cameras_of_frames(read_frames(path), DataSetPath(path, KIND), sizes_of)


def cameras_of_frames(
    frames: Sequence[Mapping[str, object]], file: DataSetPath, sizes_of: SizesOf = lambda _: ()
) -> list[PosedCamera]:
    """Return the cameras of frames, as :func:`read_nerf`."""
    names = [str(frame["file_path"]).replace("\\", "/") for frame in frames]
    sizes = [_stated_size(frame) for frame in frames]
    photograph_sizes = sizes if all(sizes) else sizes_of(names)
    cameras = [
        _camera(frame, name, size, file)
        for frame, name, *options in zip(frames, names, sizes, photograph_sizes, strict=True)
        if (size := options[0] or options[1])
    ]
    return number_lenses(cameras)


def read_cloud(path: Path) -> Points:
    """Read the points of the PLY file ``ply_file_path``, as nerfstudio does.

    They are in the frame of the cameras. Points that are not finite are skipped.

    Args:
        path: A camera file of any format.

    Returns:
        Float64; empty if no file is named, or if it is missing, with a
        :class:`~pimper_torch.runtime.errors.PimperWarning`.
    """
    nothing = torch.zeros(0, 3, dtype=torch.float64)
    if path.suffix.lower() != ".json":
        return nothing
    name = DataSetPath(path, KIND).read_json().get("ply_file_path")
    if not isinstance(name, str):
        return nothing
    cloud = DataSetPath(DataSetPath(path.parent, KIND).inside(name), KIND)
    if not cloud.path.is_file():
        caution(f"{path}: names the point cloud {name}, which does not exist. It is not used.")
        return nothing
    points = torch.from_numpy(cloud.read(_ply_points, "a PLY file"))
    return points[(points.abs() < 1e30).all(dim=1)]  # false for NaN


def _ply_points(path: Path) -> np.ndarray:
    # From bytes, so that no other file is opened.
    cloud = trimesh.load(BytesIO(path.read_bytes()), file_type="ply", process=False)
    return np.array(cloud.vertices, dtype=np.float64).reshape(-1, 3)


def _stated_size(frame: Mapping[str, object]) -> tuple[int, int] | None:
    """Return the width and height that a frame states, if any."""
    sides = frame.get("w"), frame.get("h")
    if not all(type(side) in (int, float) and 0 < float(str(side)) < math.inf for side in sides):
        return None
    return round(float(str(sides[0]))), round(float(str(sides[1])))


def _camera(
    frame: Mapping[str, object], name: str, size_px: tuple[int, int], file: DataSetPath
) -> PosedCamera:
    matrix, what = frame.get("transform_matrix"), f"transform_matrix of {name}"
    rows = matrix[:3] if isinstance(matrix, list) and len(matrix) in (3, 4) else []
    file.expect(bool(rows), f"4 rows of 4 numbers as {what}", type(matrix).__name__)
    world_from_cam = file.numbers(rows, 12, what).reshape(3, 4)
    turn, shift = world_from_cam[:, :3] * FLIP, world_from_cam[:, 3]
    pose = invert_rigid(file.rigid(turn, shift, what))
    return PosedCamera(name=name, lens=_lens(frame, name, size_px, file), cam_from_world=pose)


def _lens(
    frame: Mapping[str, object], name: str, size_px: tuple[int, int], file: DataSetPath
) -> CameraModel:
    def value(key: str, default: float = 0.0) -> float:
        given = frame.get(key)
        if given is None:
            return default
        return float(file.numbers(given, 1, f"{key} of {name}"))

    def focal_px(axis: str, side_px: float) -> float:
        stated_px, angle = value(f"fl_{axis}"), value(f"camera_angle_{axis}")
        if stated_px > 0 or angle <= 0:
            return max(stated_px, 0.0)
        if angle >= math.pi:
            raise InputError(
                f"{file.path}: camera_angle_{axis} of {name} is {angle:g}; needed: radians, below "
                f"pi. If these are degrees, write {math.radians(angle):.6g}."
            )
        return side_px / 2 / math.tan(angle / 2)

    width, height = size_px
    focal, focal_y = focal_px("x", width), focal_px("y", height)
    needed = f"fl_x or camera_angle_x, in the file or for {name}"
    file.expect(focal > 0 or focal_y > 0, needed, "neither, or none above 0")
    fx, fy = focal or focal_y, focal_y or focal
    pinhole = (fx, fy, value("cx", width / 2), value("cy", height / 2))
    k1, k2, *others = (value(f"k{number}") for number in range(1, 7))
    model = str(frame.get("camera_model") or "OPENCV")
    fisheye = model == "OPENCV_FISHEYE" or frame.get("is_fisheye") is True
    file.expect(fisheye or model in _OPENCV, f"a camera_model of {_OPENCV}", model)
    last = 4 if fisheye else 6 if model == "FULL_OPENCV" else 3
    needed = f"k{last + 1} = 0 for {name}, or a model that has it (OPENCV_FISHEYE, FULL_OPENCV)"
    file.expect(not any(others[last - 2 :]), needed, f"k3 to k6 = {others}, camera_model {model}")
    if fisheye:
        terms = (k1, k2, *others[:2])
        return opencv_lens(size_px, pinhole).replace(model="OPENCV_FISHEYE", params=pinhole + terms)
    return opencv_lens(size_px, pinhole, (k1, k2, value("p1"), value("p2"), *others))
