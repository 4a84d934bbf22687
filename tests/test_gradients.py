import pytest
import torch
from torch import nn

import pimper_torch as pt
from pimper_torch.records import SparseScene, Views
from pimper_torch.scenes import render_shape
from pimper_torch.scenes.cameras import arc_cameras
from pimper_torch.scenes.lights import wandering_lights
from pimper_torch.scenes.noise import random_speckle
from pimper_torch.scenes.shapes import Sphere
from pimper_torch.scenes.sparse import sparse_scene


class Placed(nn.Module):
    """Known cameras and cloud, round photographs that carry a gradient."""

    def __init__(self, scene: SparseScene) -> None:
        super().__init__()
        self.scene = scene

    def forward(self, views: Views, sparse_model: object = None) -> SparseScene:
        return self.scene.replace(views=views)


@pytest.mark.parametrize("scales", [[], [0.5, 1.0]], ids=["published", "rounds"])
def test_gradients_run_from_the_photographs_to_the_vertices_of_the_mesh(scales):
    generator = torch.Generator().manual_seed(31)
    cameras = arc_cameras(8, width=96, height=72, focal_px=300.0, distance=3.0, span_deg=40.0)
    lamps = wandering_lights(8, generator, distance=5.0, spread_deg=35.0, irradiance=0.6)
    texture = random_speckle(generator, cells=(0.3, 0.1), contrast=1.0)
    scene = render_shape(Sphere(), cameras, lamps.harmonics_world(), texture)
    changes = {
        "triangulate": {"num_points": 24},
        "rounds": {"all_round": False, "scales": scales},
    }
    pimper = pt.Pimper(pt.load_config(changes=changes))
    pimper.reconstruct = Placed(sparse_scene(scene, 120, generator))

    images = scene.views.images.clone().requires_grad_()
    mesh = pimper(scene.views.replace(images=images)).mesh
    assert mesh.vertices_world.requires_grad
    # Not the mean place: patches are held at their vertices. The outward bulge is free.
    outward = mesh.vertices_world.detach() / mesh.vertices_world.detach().norm(dim=1, keepdim=True)
    (mesh.vertices_world * outward).sum(dim=1)[::3].square().sum().backward()
    gradient = images.grad
    assert gradient is not None
    assert gradient.isfinite().all()
    felt = gradient.abs().amax(dim=(1, 2, 3)) > 0
    assert felt.all()  # every view shapes the surface
    # A constant factor on all photographs is the albedo's, so the shape does not feel it.
    along = (gradient * images).sum().abs()
    assert along < 0.02 * (gradient * images).abs().sum()
    assert mesh.albedo is not None
    assert mesh.albedo.requires_grad
