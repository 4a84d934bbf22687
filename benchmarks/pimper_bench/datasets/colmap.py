"""Writing of COLMAP models with photographs and masks."""

from pathlib import Path

import torch

from pimper_torch.export.picture_files import refuse_skew, write_pictures
from pimper_torch.geometry.lens_models import pinhole_lenses
from pimper_torch.records import Cameras, Views
from pimper_torch.records.shapes import Points
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.stages.sfm.colmap import write_binary


def write_colmap(
    views: Views, cameras: Cameras, folder: Path | str, *, points_world: Points | None = None
) -> None:
    """Write photographs, masks and pinholes for COLMAP.

    ``images/`` has PNG files in 8-bit sRGB, ``masks/`` masks of the same names with ``.png``
    appended, ``sparse/0/`` the model, binary.

    Args:
        views: Undistorted.
        points_world: Points of the model, without tracks and black.

    Raises:
        InputError: A camera has a skew, which COLMAP's pinhole does not support.
    """
    folder = Path(folder)
    refuse_skew(cameras, views.names, "a COLMAP model")
    files = write_pictures(views, folder, ".png")
    points = torch.zeros(0, 3) if points_world is None else points_world.detach().cpu()
    model = SparseModel(
        names=files,
        lenses=pinhole_lenses(cameras),
        cam_from_world=cameras.cam_from_world.detach().cpu().double(),
        points_world=points.double(),
    )
    colors = torch.zeros(len(points), 3, dtype=torch.uint8)
    write_binary(model, colors, folder / "sparse" / "0")
