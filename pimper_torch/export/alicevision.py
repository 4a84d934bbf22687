"""AliceVision's SfMData with maps of every view, for Meshroom and Open-RNb."""

from collections.abc import Sequence
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from pimper_torch.export.map_files import colours, with_axes
from pimper_torch.export.picture_files import write_pictures
from pimper_torch.export.reports import write_json
from pimper_torch.export.result import Result
from pimper_torch.geometry.pixels import indices_from_pixels
from pimper_torch.io.openexr import write_exr
from pimper_torch.radiometry.base_color import albedo_scale
from pimper_torch.records import Cameras
from pimper_torch.records.shapes import Matrix3
from pimper_torch.runtime.progress import part, track
from pimper_torch.viz.maps import view_maps

_VERSION = ("1", "2", "8")
_SENSOR_MM = 36.0  # AliceVision's default sensor width, to which focal lengths in mm refer


def write_alicevision(result: Result, folder: Path) -> None:
    """Write ``cameras.sfm`` of the photographs, and one such file for each kind of map.

    ``normalMaps.sfm``, ``albedoMaps.sfm`` and ``masks.sfm`` have the same views with other paths.
    Normals are EXR in OpenGL's camera axes (x right, y up, z to the viewer), which Open-RNb
    expects; albedo is EXR, linear, scaled to [0, 1]. Photographs are undistorted.
    """
    views, cameras, scale = result.masked_views, result.cameras, albedo_scale(result.mesh)
    with part(0, 2):
        files = write_pictures(views.replace(masks=result.silhouettes.masks), folder)
    maps_of = [f"{Path(file).stem}.exr" for file in files]
    for kind in ("normals", "albedos"):
        (folder / kind).mkdir(parents=True)
    with part(1, 2):
        for view, file in enumerate(track(maps_of)):
            maps = view_maps(result.mesh, result.scene.cameras, view)
            normals = with_axes(maps.normals_cam, "opengl")
            write_exr(normals, folder / "normals" / file, "x right, y up, z to the viewer")
            albedo = colours((scale * maps.albedo).clamp(0, 1))
            write_exr(albedo, folder / "albedos" / file, "linear, sRGB primaries")
    for name, kind, paths in (
        ("cameras", "images", files),
        ("normalMaps", "normals", maps_of),
        ("albedoMaps", "albedos", maps_of),
        ("masks", "masks", files),
    ):
        write_sfm(cameras, [f"{kind}/{file}" for file in paths], folder / f"{name}.sfm")


def write_sfm(cameras: Cameras, paths: Sequence[str], file: Path | str) -> None:
    """Write pinhole cameras as SfMData in JSON, with numbers as texts.

    See :func:`~pimper_torch.io.cameras.meshroom_sfm.read_meshroom` for its
    conventions.

    Args:
        cameras: Float64; skew is ignored.
        paths: Paths of the images relative to the file's folder, one per camera.
    """
    views, intrinsics, poses = [], [], []
    sizes, centers = cameras.sizes_px.tolist(), cameras.centers_world
    for index, (path, (width, height)) in enumerate(zip(paths, sizes, strict=True)):
        key, rotation = str(index + 1), cameras.cam_from_world[index, :3, :3]
        views.append(
            {
                **dict.fromkeys(("viewId", "poseId", "frameId", "intrinsicId"), key),
                "path": path,
                "width": str(width),
                "height": str(height),
                "metadata": "",
            }
        )
        intrinsics.append(_intrinsic(key, cameras.intrinsics[index], width, height))
        # Column by column.
        transform = {"rotation": _texts(rotation.T.flatten()), "center": _texts(centers[index])}
        poses.append({"poseId": key, "pose": {"transform": transform, "locked": "1"}})
    content = {"version": _VERSION, "views": views, "intrinsics": intrinsics, "poses": poses}
    write_json(content, file, indent=4)


def _intrinsic(identifier: str, K: Matrix3, width: int, height: int) -> dict[str, object]:
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
