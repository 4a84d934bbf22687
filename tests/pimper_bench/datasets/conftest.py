from pathlib import Path

import numpy as np
import pytest
import scipy.io
import torch
from PIL import Image

from pimper_bench.datasets import posed
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.lens_models import distort
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.undistortion import undistort
from pimper_torch.io.decode import write_deep_png


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(12)


@pytest.fixture
def paint():
    """Write a uniform photograph with a brighter top-left quarter."""

    def write(path: Path, level: int, width: int = 16, height: int = 12, mode: str = "RGB") -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.full((height, width, 3), level, dtype=np.uint8)
        pixels[: height // 2, : width // 2] += 20
        Image.fromarray(pixels).convert(mode).save(path)

    return write


@pytest.fixture
def paint_deep():
    """Write a 16-bit PNG of one colour, or of one colour per pixel."""

    def write(path: Path, levels: object, width: int, height: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.broadcast_to(np.asarray(levels, dtype=np.uint16), (height, width, 3))
        write_deep_png(pixels, path)

    return write


@pytest.fixture
def rig():
    """Three cameras around the origin, for photographs of 1600 x 1200."""
    return arc_cameras(3, width=1600, height=1200, focal_px=2900.0, distance=0.7)


@pytest.fixture
def save_calibration(rig):
    """Save the rig in the format of Bouguet's toolbox: pixel centres count from 0."""

    def save(path: Path, **more: object) -> None:
        K, pose = rig.intrinsics[0].numpy(), rig.cam_from_world.numpy()
        arrays = {"fc": K[[0, 1], [0, 1]][:, None], "cc": K[:2, 2:] - 0.5} | more
        for view in range(3):
            arrays[f"Rc_{view + 1}"] = pose[view, :3, :3]
            arrays[f"Tc_{view + 1}"] = pose[view, :3, 3:]
        scipy.io.savemat(path, arrays)

    return save


@pytest.fixture
def hand_camera():
    """``cam_from_world`` of a camera at (-4, 2, 3) that looks along the world's x.

    Its right is the world's y, its down the world's z. The point (6, 3, 5) is 1 to the right,
    2 down and 10 ahead; the numbers differ, so that swapped axes are detected.
    """
    rows = [[0.0, 1, 0, -2], [0, 0, 1, -3], [1, 0, 0, 4], [0, 0, 0, 1]]
    return torch.tensor(rows, dtype=torch.float64)


@pytest.fixture
def sees():
    """Project the point (6, 3, 5) into a view of a capture."""

    def pixel(capture, view: int = 0) -> list[float]:
        point = torch.tensor([[6.0, 3.0, 5.0]], dtype=torch.float64)
        cameras = capture.cameras
        pixels, depth = project(point, cameras.cam_from_world[view], cameras.intrinsics[view])
        assert depth.tolist() == pytest.approx([10])
        return pixels[0].tolist()

    return pixel


@pytest.fixture
def lens_of(monkeypatch):
    """Project the direction (x, y, 1) by the first camera model of a reader."""

    def pixel(read, folder, x: float, y: float) -> list[float]:
        found = []

        def spy(views, lenses):
            found.extend(lenses)
            return undistort(views, lenses)

        monkeypatch.setattr(posed, "undistort", spy)
        read(folder)
        ray = torch.tensor([[x, y, 1.0]], dtype=torch.float64)
        return distort(found[0], ray)[0].tolist()

    return pixel
