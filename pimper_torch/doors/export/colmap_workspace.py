"""The workspace of COLMAP's dense stereo: photographs, a model, and maps."""

from collections.abc import Sequence
from pathlib import Path

import torch

from pimper_torch.doors.export.picture_files import write_pictures
from pimper_torch.doors.export.result import Result
from pimper_torch.ground.geometry.lens_models import pinhole_lenses, undistort_pixels
from pimper_torch.ground.geometry.pixels import homogeneous
from pimper_torch.method.sfm.colmap import write_binary
from pimper_torch.method.sfm.model import select_views
from pimper_torch.method.sfm.sparse_scene import model_of_scene, point_colors
from pimper_torch.records import Cameras, SparseScene
from pimper_torch.result.viz.maps import view_maps
from pimper_torch.runtime.progress import part, track

_KINDS = ("depth_maps", "normal_maps", "consistency_graphs")


def write_workspace(result: Result, folder: Path) -> None:
    """Write what COLMAP's undistorter and dense stereo would: the surface as depths and normals.

    The undistorter itself is not run: it would resample the photographs once more.

    ``images/`` has PNG files in 8-bit sRGB, ``masks/`` masks of the same names with ``.png``
    appended, ``sparse/`` the model with its tracks. Depths are along the camera's z, normals in its
    frame (x right, y down, z forward), both 0 where a view does not see the surface:
    ``stereo_fusion`` and the meshers run on them.
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
    """Write a scene's pinholes, cloud and tracks as a model of its undistorted photographs.

    Points that fewer than two views see are left out: stereo programs take none.

    Args:
        cameras: Those of the scene, in the frame of ``scene.offset_world``.
        folder: Gets the binary files; made if it is not there.
    """
    pixels = torch.empty_like(scene.observation_pixels, dtype=torch.float64)
    for view, (lens, K) in enumerate(zip(scene.lenses, cameras.intrinsics.double(), strict=True)):
        here = scene.observation_view == view
        ends = homogeneous(undistort_pixels(lens, scene.observation_pixels[here].double()))
        pixels[here] = (ends @ K.mT)[:, :2]
    model = model_of_scene(scene).replace(
        names=tuple(files),
        lenses=pinhole_lenses(cameras),
        cam_from_world=cameras.cam_from_world.double(),
        observation_pixels=pixels,
    )
    tied = (model.observed.sum(dim=1) >= 2).to(scene.points_world.device)
    write_binary(select_views(model, range(model.num_views)), point_colors(scene)[tied], folder)
