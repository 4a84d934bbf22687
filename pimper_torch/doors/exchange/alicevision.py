"""AliceVision's SfMData with maps for every view, as Meshroom and Open-RNb read it."""

from collections.abc import Sequence
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from pimper_torch.doors.exchange.map_files import colours, with_axes
from pimper_torch.doors.exchange.openexr import write_exr
from pimper_torch.doors.exchange.picture_files import file_names, write_mask, write_picture
from pimper_torch.doors.exchange.result import Result
from pimper_torch.doors.io.reports import write_json
from pimper_torch.ground.geometry.pixels import indices_from_pixels
from pimper_torch.records import Cameras
from pimper_torch.result.viz.maps import albedo_scale, view_maps

_VERSION = ("1", "2", "8")
_SENSOR_MM = 36.0  # AliceVision's own default: focal lengths are in millimetres of it


def write_alicevision(result: Result, folder: Path) -> None:
    """Write ``cameras.sfm`` of the photographs, and beside it one file for each kind of map.

    ``normalMaps.sfm``, ``albedoMaps.sfm`` and ``masks.sfm`` have the same views with other paths.
    Normals are EXR in OpenGL's camera axes (x right, y up, z to the viewer), as Open-RNb turns
    them to the world; albedo is EXR, linear, scaled into [0, 1]. Photographs are undistorted.
    """
    views, cameras = result.masked_views, result.cameras
    files, scale = file_names(views.names), albedo_scale(result.mesh)
    maps_of = [f"{Path(file).stem}.exr" for file in files]
    for kind in ("normals", "albedos"):
        (folder / kind).mkdir(parents=True)
    for view, (file, map_file) in enumerate(zip(files, maps_of, strict=True)):
        write_picture(views, view, folder / "images" / file)
        write_mask(views, view, folder / "masks" / file)
        maps = view_maps(result.mesh, result.scene.cameras, view)
        normals = with_axes(maps.normals_cam, "opengl")
        write_exr(normals, folder / "normals" / map_file, "x right, y up, z to the viewer")
        albedo = colours((scale * maps.albedo).clamp(0, 1))
        write_exr(albedo, folder / "albedos" / map_file, "linear, sRGB primaries")
    write_sfm(cameras, [f"images/{file}" for file in files], folder / "cameras.sfm")
    write_sfm(cameras, [f"normals/{file}" for file in maps_of], folder / "normalMaps.sfm")
    write_sfm(cameras, [f"albedos/{file}" for file in maps_of], folder / "albedoMaps.sfm")
    write_sfm(cameras, [f"masks/{file}" for file in files], folder / "masks.sfm")


def write_sfm(cameras: Cameras, paths: Sequence[str], file: Path | str) -> None:
    """Write pinholes as SfMData in JSON, numbers as texts.

    See :func:`~pimper_torch.doors.camera_files.meshroom_sfm.read_meshroom_cameras` for its
    conventions.

    Args:
        cameras: Float64; a skew is left out.
        paths: Of the pictures, one a camera, from the file's folder on.
    """
    sizes = cameras.sizes_px.tolist()
    whole = {
        "version": _VERSION,
        "views": [
            {
                "viewId": str(index),
                "poseId": str(index),
                "frameId": str(index),
                "intrinsicId": str(index),
                "path": path,
                "width": str(width),
                "height": str(height),
                "metadata": "",
            }
            for index, (path, (width, height)) in enumerate(zip(paths, sizes, strict=True), start=1)
        ],
        "intrinsics": [
            _intrinsic(str(index), K, width, height)
            for index, (K, (width, height)) in enumerate(
                zip(cameras.intrinsics, sizes, strict=True), start=1
            )
        ],
        "poses": [
            {
                "poseId": str(index),
                "pose": {
                    # Column by column.
                    "transform": {"rotation": _texts(turn.T.flatten()), "center": _texts(center)},
                    "locked": "1",
                },
            }
            for index, (turn, center) in enumerate(
                zip(cameras.cam_from_world[:, :3, :3], cameras.centers_world, strict=True), start=1
            )
        ],
    }
    write_json(whole, file, indent=4)


def _intrinsic(
    identifier: str, K: Float[Tensor, "3 3"], width: int, height: int
) -> dict[str, object]:
    focal_x, focal_y = K.diagonal()[:2].tolist()
    center = indices_from_pixels(K[:2, 2]) - K.new_tensor([width, height]) / 2
    return {
        "intrinsicId": identifier,
        "width": str(width),
        "height": str(height),
        "sensorWidth": repr(_SENSOR_MM),
        "sensorHeight": repr(_SENSOR_MM * height / width),
        "serialNumber": identifier,
        "type": "pinhole",
        "initializationMode": "estimated",
        "initialFocalLength": "-1",
        "focalLength": repr(focal_x / width * _SENSOR_MM),
        "pixelRatio": repr(focal_y / focal_x),
        "pixelRatioLocked": "true",
        "principalPoint": _texts(center),
        "distortionInitializationMode": "none",
        "distortionParams": "",
        "undistortionOffset": ["0", "0"],
        "undistortionParams": "",
        "distortionType": "none",
        "undistortionType": "none",
        "locked": "true",
    }


def _texts(values: Float[Tensor, " value"]) -> list[str]:
    return [repr(value) for value in values.tolist()]
