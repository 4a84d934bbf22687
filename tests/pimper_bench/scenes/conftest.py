import pytest
import torch

from pimper_bench.scenes.scene_cameras import arc_cameras


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(61)


@pytest.fixture
def cameras():
    return arc_cameras(3, width=40, height=30, focal_px=50.0, distance=4.0)
