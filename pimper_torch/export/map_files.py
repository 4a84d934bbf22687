"""Normals, depth and albedo of every view as EXR, 16-bit PNG and NPZ."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from pimper_torch.export.picture_files import file_names
from pimper_torch.export.reports import write_json
from pimper_torch.export.result import WrittenResult
from pimper_torch.io.decode import write_deep_png
from pimper_torch.io.openexr import write_exr
from pimper_torch.records.priors import AXES, Axes
from pimper_torch.runtime.progress import track
from pimper_torch.viz.maps import view_maps


def write_maps(result: WrittenResult, folder: Path, axes: Axes = "opengl") -> None:
    """Write maps of the visible surface in every view, named like the photographs.

    ``normals/`` has unit normals as EXR, and as 16-bit PNG of ``(n + 1) / 2``; ``depth/`` and
    ``albedo/`` EXR; ``arrays/`` all of them and more as NPZ. Pixels without surface are 0, or NaN
    for depth in NPZ. ``README.json`` describes the files.

    Args:
        axes: Camera axes of the normals.
    """
    for kind in ("normals", "depth", "albedo", "arrays"):
        (folder / kind).mkdir(parents=True)
    cameras = result.mesh_cameras
    for view, file in enumerate(track(file_names(result.names))):
        maps = view_maps(result.mesh, cameras, view)
        normals, stem = with_axes(maps.normals_cam, axes), Path(file).stem
        write_exr(normals, folder / "normals" / f"{stem}.exr", AXES[axes][1])
        levels = (65535 * (normals + 1) / 2).round() * maps.seen.numpy()[..., None]
        write_deep_png(levels.astype(np.uint16), folder / "normals" / file)
        depth = maps.depth.nan_to_num(0)[..., None].numpy()
        write_exr(depth, folder / "depth" / f"{stem}.exr", "along the camera's axis")
        write_exr(colours(maps.albedo), folder / "albedo" / f"{stem}.exr", "linear, sRGB primaries")
        np.savez_compressed(
            folder / "arrays" / f"{stem}.npz",
            normals=normals,
            axes=np.array(axes),
            albedo=maps.albedo.numpy(),
            **maps.arrays(),
            intrinsics=result.cameras.intrinsics[view].numpy(),
            cam_from_world=result.cameras.cam_from_world[view].numpy(),
            name=np.array(result.names[view]),
            allow_pickle=False,
        )
    about = {
        "axes": axes,
        "normals": f"unit, {AXES[axes][1]}; PNG is 65535 (n + 1) / 2; 0 off the surface",
        "depth": "along the camera's axis, in the result's unit; 0 off the surface, NaN in NPZ",
        "albedo": "linear, primaries of sRGB, one scale for all views; 0 off the surface",
        "cameras": "NPZ: in intrinsics, the centre of the top-left pixel is (0.5, 0.5); "
        "cam_from_world has camera axes x right, y down, z into the scene, for all axes of normals",
    }
    write_json(about, folder / "README.json")


def with_axes(normals_cam: Float[Tensor, "height width 3"], axes: Axes) -> np.ndarray:
    """Convert normals from our camera axes to different ones; float32."""
    normals = normals_cam.numpy() * np.array(AXES[axes][0], np.float32) + np.float32(0)  # no -0
    return np.asarray(normals, np.float32)


def colours(albedo: Float[Tensor, "height width channel"]) -> np.ndarray:
    """Return albedo with three channels, also if it is grey; float32."""
    return np.asarray(albedo.expand(-1, -1, 3).numpy(), np.float32)
