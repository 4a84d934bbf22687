"""Cameras of Meshroom and AliceVision: ``cameras.sfm``, and any other SfMData in JSON."""

from collections.abc import Mapping
from pathlib import Path, PureWindowsPath

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.camera_files.layout import expect, numbers, objects, read_json
from pimper_torch.camera_files.posed_camera import PosedCamera, rigid_or_refuse
from pimper_torch.errors import some
from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.records import Lens

KIND = "a Meshroom cameras.sfm"
# Names of the distortions, as `type` before version 1.2.6 and as `distortionType` since,
# by how many parameters they have.
_RADIAL = {"radial1": 1, "radial3": 3, "radialk1": 1, "radialk3": 3}
_NONE = ("pinhole", "none")
_MAX_FOCAL_PX = 1e9  # of no lens


def read_meshroom_cameras(path: Path) -> list[PosedCamera]:
    """Read the cameras, which are called by the paths of their photographs.

    As AliceVision reads its own file (``sfmDataIO/jsonIO.cpp``):

    - ``rotation`` is ``cam_from_world``, column by column; ``center`` is the camera's position;
      the camera's axes are ours.
    - Before version 1.2 of the file ``pxFocalLength`` is one number, in 1.2.0 and 1.2.1 two;
      from 1.2.2 on ``focalLength`` is in mm of a sensor ``sensorWidth`` wide, and
      ``fy = fx / pixelRatio``, from 1.2.5 on ``fy = fx * pixelRatio``.
    - ``principalPoint`` counts from the top-left before 1.2.1, from (width / 2, height / 2)
      since.
    - Its images are sampled at whole numbers (``UndistortImage``): it counts centres from
      0, so half a pixel is added.

    Views without a pose are not registered, and are left out.

    Raises:
        InputError: The file has another structure or describes a lens or rig that cannot be
            read.
    """
    whole = read_json(path, KIND)
    version = tuple(int(part) for part in numbers(whole.get("version"), 3, "version", path, KIND))
    poses = _by_id(whole, "poses", "poseId", path)
    lenses = {
        key: _lens(entry, version, number, path)
        for number, (key, entry) in enumerate(
            _by_id(whole, "intrinsics", "intrinsicId", path).items(), start=1
        )
    }
    cameras = []
    for view in objects(whole.get("views"), "views", path, KIND):
        name = PureWindowsPath(str(view.get("path"))).name  # takes both kinds of slash
        pose, lens = poses.get(str(view.get("poseId"))), lenses.get(str(view.get("intrinsicId")))
        if pose is None or lens is None:
            continue
        independent = str(view.get("isPoseIndependant", "true")) not in ("false", "0")
        rig = "a pose in a rig, which cannot be read; export without rigs"
        expect(independent, path, KIND, f"a pose of its own for {name}", rig)
        placed = _cam_from_world(pose, name, path)
        cameras.append(PosedCamera(name=str(view.get("path")), lens=lens, cam_from_world=placed))
    expect(bool(cameras), path, KIND, "views with a pose and intrinsics", "none")
    return cameras


def _by_id(
    whole: Mapping[str, object], section: str, key: str, path: Path
) -> dict[str, dict[str, object]]:
    entries = objects(whole.get(section), section, path, KIND)
    return {str(entry.get(key)): entry for entry in entries}


def _cam_from_world(entry: Mapping[str, object], name: str, path: Path) -> Float[Tensor, "4 4"]:
    pose = entry.get("pose")
    inner = pose.get("transform") if isinstance(pose, Mapping) else None
    expect(isinstance(inner, Mapping), path, KIND, f"pose.transform for {name}", repr(inner))
    transform: Mapping[str, object] = inner if isinstance(inner, Mapping) else {}
    columns = numbers(transform.get("rotation"), 9, f"rotation of {name}", path, KIND)
    center = numbers(transform.get("center"), 3, f"center of {name}", path, KIND)
    rotation = columns.reshape(3, 3).T
    cam_from_center = rigid_or_refuse(rotation, center, f"rotation of {name}", path, KIND)
    exact = cam_from_center[:3, :3]
    return rigid_or_refuse(exact, -exact @ center, f"rotation of {name}", path, KIND)


def _lens(entry: Mapping[str, object], version: tuple[int, ...], camera: int, path: Path) -> Lens:
    def value(key: str, count: int = 1) -> Float[Tensor, " value"]:
        return numbers(entry.get(key), count, f"{key} of an intrinsic", path, KIND)

    size = torch.cat([value("width"), value("height")])
    width, height = (int(side) for side in size)
    focal = _focal(entry, version, width, path)
    positive = bool(((focal > 0) & (focal < _MAX_FOCAL_PX)).all())
    expect(positive, path, KIND, "a positive focal length", f"{focal.tolist()}")
    center = value("principalPoint", 2)
    center = pixels_from_indices(center if version < (1, 2, 1) else center + size / 2)
    pinhole = (float(focal[0]), float(focal[1]), float(center[0]), float(center[1]))
    model, params = _distortion(entry, path)
    return Lens(camera=camera, model=model, params=(*pinhole, *params), width=width, height=height)


def _focal(
    entry: Mapping[str, object], version: tuple[int, ...], width: int, path: Path
) -> Float[Tensor, "2"]:
    """Return the focal lengths in pixels, in the words of every version of the file."""

    def value(key: str, count: int = 1, default: object = None) -> Float[Tensor, " value"]:
        return numbers(entry.get(key, default), count, f"{key} of an intrinsic", path, KIND)

    if version < (1, 2, 0):
        return value("pxFocalLength").expand(2)
    if version < (1, 2, 2):
        return value("pxFocalLength", 2)
    fx = value("focalLength") / value("sensorWidth", default=36.0) * width
    ratio = value("pixelRatio", default=1.0)
    return torch.cat([fx, fx / ratio if version < (1, 2, 5) else fx * ratio])


def _distortion(entry: Mapping[str, object], path: Path) -> tuple[str, tuple[float, ...]]:
    """Translate a distortion to COLMAP's model and what its parameters are after the centre.

    AliceVision's Brown model has (k1, k2, k3, t1, t2) and is OpenCV's, its ``fisheye4`` is
    OpenCV's fisheye: so its own exporter to COLMAP has it (``sfmDataIO/colmap.cpp``).
    """
    name = str(entry.get("distortionType") or entry.get("type"))
    if name == "none" or "distortionType" not in entry:
        name = str(entry.get("type"))
    params = entry.get("distortionParams") or []  # an empty list is written as ""
    count = len(params) if isinstance(params, list) else -1
    values = [
        float(value) for value in numbers(params, max(count, 0), "distortionParams", path, KIND)
    ]
    undone = entry.get("undistortionParams") or []
    needed = _RADIAL.get(name, {"brown": 5, "fisheye4": 4}.get(name, 0))
    known = name in _NONE or name in _RADIAL or name in ("brown", "fisheye4")
    expect(
        known and not undone and (count == needed or name in _NONE),
        path,
        KIND,
        f"a lens that is one of {some([*_NONE, *_RADIAL, 'brown', 'fisheye4'], 10)}",
        f"{name} with {count} parameters{' and an undistortion' if undone else ''}; export the "
        "undistorted photographs with their cameras",
    )
    if name == "fisheye4":
        return "OPENCV_FISHEYE", tuple(values)
    k1, k2, k3, t1, t2 = (*values, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    if name in _NONE or not any(values):
        return "PINHOLE", ()
    return "FULL_OPENCV", (k1, k2, t1, t2, k3, 0.0, 0.0, 0.0)
