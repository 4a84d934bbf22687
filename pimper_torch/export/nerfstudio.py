"""NeRF's ``transforms.json``, for nerfstudio, instant-ngp and Brush."""

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor

from pimper_torch.export.picture_files import file_names, refuse_skew, write_pictures
from pimper_torch.export.reports import write_json
from pimper_torch.export.result import Result
from pimper_torch.geometry.rigid import invert_rigid, transform
from pimper_torch.io.cameras.transforms_json import FLIP
from pimper_torch.io.meshes import write_ply
from pimper_torch.records import Cameras, Mesh, Views
from pimper_torch.records.shapes import Points
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.progress import part, track
from pimper_torch.viz.maps import view_maps

_DEPTH_UNIT = 1e-3  # `depth_unit_scale_factor` of nerfstudio's NerfstudioDataParserConfig


def write_transforms(
    views: Views,
    cameras: Cameras,
    folder: Path | str,
    *,
    points_world: Points | None = None,
    albedo: Float[Tensor, "point channel"] | None = None,
    depth_unit: float | None = None,
) -> None:
    """Write ``transforms.json`` for nerfstudio, with ``images/`` and ``masks/``.

    Intrinsics that all views share are written once at the top level, where instant-ngp reads them.

    Args:
        views: Undistorted.
        points_world: A cloud, written as ``sparse_pc.ply`` and named in the file.
        depth_unit: Unit of the files in ``depths/``, which are named for every view, but which
            this function does not write.

    Raises:
        InputError: A camera has a skew, which the format cannot represent.
    """
    folder = Path(folder)
    refuse_skew(cameras, views.names, "transforms.json")
    files = write_pictures(views, folder)
    world_from_cam = invert_rigid(cameras.cam_from_world.detach().cpu().double()).clone()
    world_from_cam[:, :3, :3] *= FLIP
    lenses, frames = [], []
    for index, file in enumerate(files):
        frame: dict[str, object] = {"file_path": f"images/{file}"}
        if views.masks is not None:
            frame["mask_path"] = f"masks/{file}"
        if depth_unit is not None:
            frame["depth_file_path"] = f"depths/{file}"
        frame["transform_matrix"] = world_from_cam[index].tolist()
        frames.append(frame)
        K = cameras.intrinsics[index].detach().cpu().double()
        width, height = cameras.sizes_px[index].tolist()
        lens = {"w": width, "h": height, "fl_x": float(K[0, 0]), "fl_y": float(K[1, 1])}
        lenses.append({**lens, "cx": float(K[0, 2]), "cy": float(K[1, 2])})
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    if not shared:
        frames = [{**lens, **frame} for lens, frame in zip(lenses, frames, strict=True)]
    content: dict[str, object] = {"camera_model": "PINHOLE", **shared}
    if depth_unit is not None:
        content["depth_unit_scale_factor"] = depth_unit
    if points_world is not None:
        content["ply_file_path"] = "sparse_pc.ply"
        faces = torch.zeros(0, 3, dtype=torch.long)
        points = Mesh(vertices_world=points_world, faces=faces, albedo=albedo)
        write_ply(points, folder / "sparse_pc.ply")
    write_json({**content, "frames": frames}, folder / "transforms.json")


def write_nerfstudio(result: Result, folder: Path) -> None:
    """Write a result as :func:`write_transforms`, with silhouettes as masks and with depth maps.

    The cloud consists of coloured vertices of the surface, as a start for Gaussian splatting.
    ``depths/`` has PNG files of 16 bits: depth along the camera's axis in units of
    ``depth_unit_scale_factor``, 0 where the surface is not visible. The factor is nerfstudio's
    default, 0.001, unless depths are out of its range. It is then a different power of ten, and a
    :class:`~pimper_torch.runtime.errors.PimperWarning` names the option for it.
    """
    vertices, albedo = result.mesh.vertices_world, result.mesh.albedo
    cameras, chosen = result.mesh_cameras, point_subset(len(vertices))
    unit = depth_unit(float(transform(cameras.cam_from_world, vertices)[..., 2].max()))
    if unit != _DEPTH_UNIT:
        caution(
            f"nerfstudio: 16-bit depths of this result are in units of {unit:g}, while nerfstudio "
            f"expects {_DEPTH_UNIT:g}. For methods that use depths, add "
            f"`nerfstudio-data --depth-unit-scale-factor {unit:g}`.",
            stacklevel=3,
        )
    with part(0, 2):
        write_transforms(
            result.masked_views,
            result.cameras,
            folder,
            points_world=vertices[chosen].double() + torch.tensor(result.offset_world).double(),
            albedo=None if albedo is None else albedo[chosen],
            depth_unit=unit,
        )
    (folder / "depths").mkdir()
    with part(1, 2):
        for view, file in enumerate(track(file_names(result.names))):
            depth = view_maps(result.mesh, cameras, view).depth.nan_to_num(0)
            levels = (depth.double() / unit).round().numpy().astype(np.uint16)
            Image.fromarray(levels).save(folder / "depths" / file)


def depth_unit(farthest: float) -> float:
    """Return the power of ten that fits depths into 16 bits, with steps of at most 0.1 %.

    >>> depth_unit(6.4), depth_unit(500.0), depth_unit(0.25)
    (0.001, 0.01, 0.0001)
    """
    lowest, highest = math.log10(farthest / 65535), math.log10(farthest / 1000)
    return 10.0 ** max(math.ceil(lowest), min(round(math.log10(_DEPTH_UNIT)), math.floor(highest)))


def point_subset(count: int) -> Int[Tensor, " point"]:
    """Return the indices of at most 100,000 of ``count`` points, evenly spaced."""
    return torch.linspace(0, count - 1, min(count, 100_000), dtype=torch.float64).round().long()
