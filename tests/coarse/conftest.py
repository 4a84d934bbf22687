import pytest
import torch

from pimper_bench.scenes.render_in_memory import Sphere, render_shape
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.true_clouds import sparse_scene
from pimper_torch.records import SparseScene
from tests.coarse.ball import all_round, photographed


@pytest.fixture(scope="session")
def dome_cloud() -> SparseScene:
    """A ball seen from five views on an arc of 50 degrees, with a thousand exact points."""
    cameras = arc_cameras(5, width=160, height=120, focal_px=200.0, distance=4.0, sway_deg=0.0)
    lights = torch.tensor([[0.4, 0.0, 0.0, 0.4]], dtype=torch.float64).expand(5, 4)
    scene = render_shape(Sphere(), cameras, lights, lambda points: torch.ones_like(points))
    return sparse_scene(scene, 1000, torch.Generator().manual_seed(0))


@pytest.fixture(scope="session")
def round_about() -> SparseScene:
    """A ball seen from 12 positions on all sides."""
    return photographed(all_round())
