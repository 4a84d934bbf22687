from types import SimpleNamespace

import pytest
import torch

from pimper_bench.scenes import SceneConfig, build_scene, render_objects, sparse_scene
from pimper_torch.records import Silhouettes


@pytest.fixture(scope="session")
def rendered():
    """A mug on its table from 12 places, its cloud with noise, and the truth."""
    config = SceneConfig(num_views=12, width=160, height=120, supersample=1)
    made = build_scene("mug", config)
    generator = torch.Generator().manual_seed(0)
    truth = render_objects(made.objects, made.cameras, made.lights, generator)
    scene = sparse_scene(truth, 300, generator, noise_px=0.3)
    world = truth.normals_world.float()
    camera = torch.einsum("vij,vhwj->vhwi", scene.cameras.cam_from_world[:, :3, :3], world)
    return SimpleNamespace(
        scene=scene,
        world=world,
        camera=camera,
        depth=truth.depth.float(),
        silhouettes=Silhouettes(
            inside=truth.foreground.float(),
            reliable=torch.ones(12, dtype=torch.bool),
            source="masks",
        ),
    )
