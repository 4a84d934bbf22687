"""Cameras of Meshroom and AliceVision: ``cameras.sfm``, and any other SfMData in JSON."""

from collections.abc import Mapping
from pathlib import Path, PureWindowsPath

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.posed_camera import Numbers, PosedCamera, opencv_lens
from pimper_torch.records import CameraModel
from pimper_torch.records.shapes import Pose
from pimper_torch.runtime.errors import some

KIND = "a Meshroom cameras.sfm"
# Number of parameters of each distortion, by its name: `type` before version 1.2.6 of the file,
# `distortionType` since.
_PARAMETERS = {"radial1": 1, "radial3": 3, "radialk1": 1, "radialk3": 3, "brown": 5, "fisheye4": 4}
_NONE = ("pinhole", "none")


def read_meshroom(path: Path, *_: object) -> list[PosedCamera]:
    """Read the cameras, named by the paths of their photographs.

    As AliceVision reads its own file (``sfmDataIO/jsonIO.cpp``):

    - ``rotation`` is ``cam_from_world``, column by column; ``center`` is the camera's position;
      the camera's axes are ours.
    - Before version 1.2 of the file ``pxFocalLength`` is one number, in 1.2.0 and 1.2.1 two;
      from 1.2.2 on ``focalLength`` is in mm of a sensor ``sensorWidth`` wide, and
      ``fy = fx / pixelRatio``, from 1.2.5 on ``fy = fx * pixelRatio``.
    - ``principalPoint`` counts from the top-left before 1.2.1, from (width / 2, height / 2)
      since.
    - Images are sampled at integer coordinates (``UndistortImage``): pixel centres count from
      0, so half a pixel is added.

    Views without a pose are not registered and are skipped.

    Raises:
        InputError: The file has a different structure, or a lens or rig that is not supported.
    """
    file = DataSetPath(path, KIND)
    content = file.read_json()
    version = tuple(int(part) for part in file.numbers(content.get("version"), 3, "version"))
    poses, intrinsics = (
        {str(entry.get(key)): entry for entry in file.objects(content.get(section), section)}
        for section, key in (("poses", "poseId"), ("intrinsics", "intrinsicId"))
    )
    lenses = {
        key: _lens(entry, version, number, file)
        for number, (key, entry) in enumerate(intrinsics.items(), start=1)
    }
    cameras = []
    for view in file.objects(content.get("views"), "views"):
        name = PureWindowsPath(str(view.get("path"))).name  # splits at both kinds of slash
        pose, lens = poses.get(str(view.get("poseId"))), lenses.get(str(view.get("intrinsicId")))
        if pose is None or lens is None:
            continue
        independent = str(view.get("isPoseIndependant", "true")) not in ("false", "0")
        rig = "a pose in a rig, which is not supported; export without rigs"
        file.expect(independent, f"an independent pose for {name}", rig)
        posed = _cam_from_world(pose, name, file)
        cameras.append(PosedCamera(name=str(view.get("path")), lens=lens, cam_from_world=posed))
    file.expect(bool(cameras), "views with a pose and intrinsics", "none")
    return cameras


def _cam_from_world(entry: Mapping[str, object], name: str, file: DataSetPath) -> Pose:
    pose = entry.get("pose")
    transform = pose.get("transform") if isinstance(pose, Mapping) else None
    if not isinstance(transform, Mapping):
        file.refuse(f"pose.transform for {name}", repr(transform))
    what = f"rotation of {name}"
    rotation = file.numbers(transform.get("rotation"), 9, what).reshape(3, 3).T
    center = file.numbers(transform.get("center"), 3, f"center of {name}")
    exact = file.rigid(rotation, center, what)[:3, :3]
    return file.rigid(exact, -exact @ center, what)


def _lens(
    entry: Mapping[str, object], version: tuple[int, ...], camera: int, file: DataSetPath
) -> CameraModel:
    def value(key: str, count: int = 1, default: object = None) -> Float[Tensor, " value"]:
        return file.numbers(entry.get(key, default), count, f"{key} of an intrinsic")

    size = torch.cat([value("width"), value("height")])
    width, height = (int(side) for side in size)
    if version < (1, 2, 0):
        focal = value("pxFocalLength").expand(2)
    elif version < (1, 2, 2):
        focal = value("pxFocalLength", 2)
    else:
        fx = value("focalLength") / value("sensorWidth", default=36.0) * width
        ratio = value("pixelRatio", default=1.0)
        focal = torch.cat([fx, fx / ratio if version < (1, 2, 5) else fx * ratio])
    positive = bool(((focal > 0) & (focal < 1e9)).all())
    file.expect(positive, "a positive focal length", f"{focal.tolist()}")
    center = value("principalPoint", 2)
    center = pixels_from_indices(center if version < (1, 2, 1) else center + size / 2)
    pinhole = (float(focal[0]), float(focal[1]), float(center[0]), float(center[1]))
    fisheye, terms = _distortion(entry, file)
    lens = opencv_lens((width, height), pinhole, () if fisheye else terms, camera)
    return lens.replace(model="OPENCV_FISHEYE", params=pinhole + terms) if fisheye else lens


def _distortion(entry: Mapping[str, object], file: DataSetPath) -> tuple[bool, Numbers]:
    """Return whether a lens is a fisheye, and the terms of OpenCV's model.

    AliceVision's Brown model (k1, k2, k3, t1, t2) is OpenCV's, and its ``fisheye4`` is OpenCV's
    fisheye, as in its own exporter to COLMAP (``sfmDataIO/colmap.cpp``).
    """
    name = str(entry.get("distortionType") or entry.get("type"))
    if name == "none" or "distortionType" not in entry:
        name = str(entry.get("type"))
    params = entry.get("distortionParams") or []  # an empty list is written as ""
    count = len(params) if isinstance(params, list) else -1
    values = file.numbers(params, max(count, 0), "distortionParams").tolist()
    undistortion = entry.get("undistortionParams") or []
    count_fits = name in _NONE or count == _PARAMETERS.get(name)
    file.expect(
        count_fits and not undistortion,
        f"a distortion that is one of {some([*_NONE, *_PARAMETERS], 10)}",
        f"{name} with {count} parameters{' and an undistortion' if undistortion else ''}; export "
        "the undistorted photographs with their cameras",
    )
    if name == "fisheye4":
        return True, tuple(values)
    k1, k2, k3, t1, t2 = (*([] if name in _NONE else values), 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    return False, (k1, k2, t1, t2, k3)
