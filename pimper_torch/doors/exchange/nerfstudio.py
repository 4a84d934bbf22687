"""NeRF's ``transforms.json``, as nerfstudio, instant-ngp and Brush read it."""

from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.doors.camera_files.transforms_json import FLIP
from pimper_torch.doors.exchange.picture_files import refuse_skew, write_pictures
from pimper_torch.doors.exchange.result import Result
from pimper_torch.doors.io.meshes import write_ply
from pimper_torch.doors.io.reports import write_json
from pimper_torch.ground.geometry.rigid import invert_rigid
from pimper_torch.ground.shapes import Points
from pimper_torch.records import Cameras, Mesh, Views


def write_transforms(
    views: Views,
    cameras: Cameras,
    folder: Path | str,
    *,
    points_world: Points | None = None,
    albedo: Float[Tensor, "point channel"] | None = None,
) -> None:
    """Write ``transforms.json`` as nerfstudio reads it, with ``images/`` and ``masks/``.

    Intrinsics that all views share stand once in the file, where instant-ngp looks for them.

    Args:
        views: Undistorted.
        points_world: A cloud, written as ``sparse_pc.ply`` and named in the file.

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
        points = Mesh(vertices_world=points_world, faces=faces, albedo=albedo)
        write_ply(points, folder / "sparse_pc.ply")
    write_json({**whole, "frames": frames}, folder / "transforms.json")


def write_nerfstudio(result: Result, folder: Path) -> None:
    """Write :func:`write_transforms` of a result, with silhouettes for masks.

    The cloud is made of vertices of the surface, in their colours: Gaussian splatting starts there.
    """
    vertices, albedo = result.mesh.vertices_world, result.mesh.albedo
    chosen = thinned(len(vertices))
    write_transforms(
        result.masked_views,
        result.cameras,
        folder,
        points_world=vertices[chosen].double() + torch.tensor(result.scene.offset_world).double(),
        albedo=None if albedo is None else albedo[chosen],
    )


def thinned(count: int) -> Int[Tensor, " point"]:
    """Choose at most a hundred thousand of so many points, evenly."""
    return torch.linspace(0, count - 1, min(count, 100_000), dtype=torch.float64).round().long()


def _said(cameras: Cameras, index: int) -> dict[str, float | int]:
    """Put a pinhole in the words of the format."""
    K = cameras.intrinsics[index].detach().cpu().double()
    values = (*cameras.sizes_px[index].tolist(), *K.diagonal()[:2].tolist(), *K[:2, 2].tolist())
    return dict(zip(("w", "h", "fl_x", "fl_y", "cx", "cy"), values, strict=True))
