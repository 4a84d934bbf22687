"""Workspace of COLMAP's dense stereo: photographs, a sparse model, and maps."""

from collections.abc import Sequence
from pathlib import Path

import torch

from pimper_torch.export.picture_files import write_pictures
from pimper_torch.export.result import Result
from pimper_torch.geometry.lens_models import pinhole_lenses, undistort_pixels
from pimper_torch.geometry.pixels import homogeneous
from pimper_torch.records import Cameras, SparseScene
from pimper_torch.records.sparse_model import select_views
from pimper_torch.runtime.progress import part, track
from pimper_torch.stages.sfm.colmap import write_binary
from pimper_torch.stages.sfm.sparse_scene import model_of_scene, point_colors
from pimper_torch.viz.maps import view_maps

_KINDS = ("depth_maps", "normal_maps", "consistency_graphs")


def write_workspace(result: Result, folder: Path) -> None:
    """Write a result as COLMAP's undistorter and dense stereo would, with its depths and normals.

    The undistorter itself is not run, as it would resample the photographs once more.

    ``images/`` has PNG files in 8-bit sRGB, ``masks/`` masks of the same names with ``.png``
    appended, ``sparse/`` the model with its tracks. Depths are along the camera's z, normals in its
    frame (x right, y down, z forward), both 0 where the surface is not visible.
    ``stereo_fusion`` and the meshers run on these maps.
    """
    scene = result.scene
    with part(0, 2):
        files = write_pictures(result.masked_views, folder, ".png")
    write_pinholes(scene, result.cameras, files, folder / "sparse")
    stereo = folder / "stereo"
    for kind in _KINDS:
        (stereo / kind).mkdir(parents=True)
    pairs = "".join(f"{name}\n__auto__, 20\n" for name in files)
    (stereo / "patch-match.cfg").write_text(pairs, encoding="utf-8")
    (stereo / "fusion.cfg").write_text("".join(f"{name}\n" for name in files), encoding="utf-8")
    with part(1, 2):
        for view, file in enumerate(track(files)):
            maps = view_maps(result.mesh, scene.cameras, view)
            depths = maps.depth.nan_to_num(0)[..., None]
            for kind, values in zip(_KINDS, (depths, maps.normals_cam), strict=False):
                height, width, channels = values.shape
                # COLMAP's arrays of float32: row by row, channel after channel (``mvs/mat.h``).
                planes = values.movedim(-1, 0).contiguous().numpy().astype("<f4")
                head = f"{width}&{height}&{channels}&".encode("ascii")
                (stereo / kind / f"{file}.geometric.bin").write_bytes(head + planes.tobytes())


def write_pinholes(
    scene: SparseScene, cameras: Cameras, files: Sequence[str], folder: Path
) -> None:
    """Write a COLMAP model of a scene's undistorted photographs: pinholes, cloud and tracks.

    Points that fewer than two views observe are excluded, as stereo programs reject them.

    Args:
        cameras: Cameras of the scene, in the frame of ``scene.offset_world``.
        folder: Folder of the binary files; created if missing.
    """
    pixels = torch.empty_like(scene.observation_pixels, dtype=torch.float64)
    for view, (lens, K) in enumerate(zip(scene.lenses, cameras.intrinsics.double(), strict=True)):
        in_view = scene.observation_view == view
        ends = homogeneous(undistort_pixels(lens, scene.observation_pixels[in_view].double()))
        pixels[in_view] = (ends @ K.mT)[:, :2]
    model = model_of_scene(scene).replace(
        names=tuple(files),
        lenses=pinhole_lenses(cameras),
        cam_from_world=cameras.cam_from_world.double(),
        observation_pixels=pixels,
    )
    shared = (model.observed.sum(dim=1) >= 2).to(scene.points_world.device)
    write_binary(select_views(model, range(model.num_views)), point_colors(scene)[shared], folder)
