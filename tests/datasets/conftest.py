from pathlib import Path

import kornia_rs.io
import numpy as np
import pytest
import scipy.io
import torch
from PIL import Image

from pimper_torch.scenes.cameras import arc_cameras


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(12)


@pytest.fixture
def paint():
    """Write a photograph of one level with a brighter top-left quarter."""

    def write(path: Path, level: int, width: int = 16, height: int = 12, mode: str = "RGB") -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.full((height, width, 3), level, dtype=np.uint8)
        pixels[: height // 2, : width // 2] += 20
        Image.fromarray(pixels).convert(mode).save(path)

    return write


@pytest.fixture
def paint_deep():
    """Write a 16-bit PNG of one colour, or of colours pixel by pixel."""

    def write(path: Path, levels: object, width: int, height: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.broadcast_to(np.asarray(levels, dtype=np.uint16), (height, width, 3))
        kornia_rs.io.write_image_png_u16(str(path), np.ascontiguousarray(pixels), "rgb")

    return write


@pytest.fixture
def rig():
    """Three cameras round the origin, for photographs of 1600 x 1200."""
    return arc_cameras(3, width=1600, height=1200, focal_px=2900.0, distance=0.7)


@pytest.fixture
def save_calibration(rig):
    """Save the rig as Bouguet's toolbox does: pixel centres from 0."""

    def save(path: Path, **more: object) -> None:
        K, pose = rig.intrinsics[0].numpy(), rig.cam_from_world.numpy()
        arrays = {"fc": K[[0, 1], [0, 1]][:, None], "cc": K[:2, 2:] - 0.5} | more
        for view in range(3):
            arrays[f"Rc_{view + 1}"] = pose[view, :3, :3]
            arrays[f"Tc_{view + 1}"] = pose[view, :3, 3:]
        scipy.io.savemat(path, arrays)

    return save
