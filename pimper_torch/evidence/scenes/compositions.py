"""Scenes ready to be photographed."""

import torch

from pimper_torch.evidence.scenes.cameras import arc_cameras
from pimper_torch.evidence.scenes.lights import wandering_lights
from pimper_torch.evidence.scenes.meshes import potato, table
from pimper_torch.evidence.scenes.noise import random_speckle
from pimper_torch.evidence.scenes.render import render_objects
from pimper_torch.evidence.scenes.rendered import RenderedScene
from pimper_torch.evidence.scenes.scene_object import SceneObject


def potato_on_table(
    seed: int = 0,
    *,
    num_views: int = 12,
    width: int = 640,
    height: int = 480,
) -> RenderedScene:
    """Photograph a bumpy, textured potato under a point light that moves between photographs.

    The point light is two to three times the potato's length away, so its light falls off over
    the object, and the potato shadows itself and the table.

    Args:
        seed: Decides form, texture, lights and noise.
        num_views: On an arc at about 35 degrees over the table.
    """
    generator = torch.Generator().manual_seed(seed)
    objects = (
        SceneObject(
            mesh=potato(generator),
            texture=random_speckle(generator, contrast=1.5),
            roughness=0.35,
        ),
        SceneObject(
            mesh=table(),
            texture=random_speckle(
                generator, cells=(0.53, 0.23, 0.097, 0.043, 0.019), contrast=1.5
            ),
            surroundings=True,
        ),
    )
    centre = (0.0, 0.0, 0.7)
    cameras = arc_cameras(
        num_views,
        width=width,
        height=height,
        focal_px=1.25 * width,
        distance=4.6,
        span_deg=50.0,
        elevation_deg=35.0,
        target=centre,
        front=(0.0, -1.0, 0.0),
        up=(0.0, 0.0, 1.0),
    )
    lights = wandering_lights(
        num_views,
        generator,
        distance=6.0,
        target=centre,
        toward=(0.0, -0.6, 0.8),
    )
    return render_objects(objects, cameras, lights, generator)
