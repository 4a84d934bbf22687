"""Captures of the two DTU sets: one calibrated camera, several point lights a position."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.evidence.datasets.raster import intrinsics_from_indices, read_photographs
from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.radiometry import Encoding
from pimper_torch.records import Cameras, Capture, Truth

CALIBRATED_WIDTH = 1600  # of 1600 x 1200; copies of half the size exist


def dtu_capture(
    paths: Sequence[Path],
    positions: Sequence[int],
    point_lights: Sequence[int],
    cameras: tuple[Float[Tensor, "position 3 3"], Float[Tensor, "position 4 4"]],
    truth: Truth,
    *,
    encoding: Encoding,
    max_size_px: int,
) -> Capture:
    """Read photographs and give each the camera of its position.

    Args:
        cameras: Intrinsics, whose pixels count from the centre of the first one, and poses of
            the different positions in ascending order.
        truth: Of the scene.
        encoding: Response, saturation and black level of the files.
        max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.

    Raises:
        InputError: A photograph cannot be read, or their sizes differ.
    """
    order = sorted(set(positions))
    index = torch.tensor([order.index(position) for position in positions])
    views = read_photographs(
        paths, [path.name for path in paths], encoding=encoding, max_size_px=max_size_px
    )
    K, cam_from_world = cameras
    factor = float(views.sizes_px[0, 0]) / CALIBRATED_WIDTH
    K = scale_intrinsics(intrinsics_from_indices(K), factor, factor)
    return Capture(
        views=views,
        cameras=Cameras(
            intrinsics=K[index].float(),
            cam_from_world=cam_from_world[index].float(),
            sizes_px=views.sizes_px,
        ),
        truth=truth,
        position=torch.tensor(positions),
        light=torch.tensor(point_lights),
    )
