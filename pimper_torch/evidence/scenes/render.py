"""Photographs computed from geometry, light and texture, with the truth beside them.

:func:`render_shape` obeys first-order lighting exactly, so that what a stage gets wrong is
the stage's own fault. :func:`render_objects` does not: near light, cast and attached
shadows, highlights, noise and saturation are what photographs have.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.evidence.scenes.frame import render_frame
from pimper_torch.evidence.scenes.lights import Lights
from pimper_torch.evidence.scenes.rendered import RenderedScene
from pimper_torch.evidence.scenes.scene_object import SceneObject, Texture
from pimper_torch.evidence.scenes.sensor import SensorConfig
from pimper_torch.evidence.scenes.shapes import Shape
from pimper_torch.evidence.scenes.stage import Stage
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.records import Cameras, Views


def render_shape(
    shape: Shape, cameras: Cameras, lights_world: Float[Tensor, "view 4"], texture: Texture
) -> RenderedScene:
    """Photograph a closed form so that ``J = albedo * max(0, l . (1, n))`` holds exactly.

    One ray through every pixel's centre; no cast shadows, noise, fall-off or saturation.
    Precision is that of the cameras.
    """
    images, depths, normals, albedos = [], [], [], []
    for view in range(cameras.num_views):
        center, rays = cameras.centers_world[view], _rays(cameras, view)
        depth = shape.intersect(center.expand_as(rays), rays)
        hit = depth.isfinite()
        points = center + torch.where(hit, depth, 1)[..., None] * rays
        normal = torch.where(hit[..., None], shape.normals(points), 0)
        albedo = torch.where(hit[..., None], texture(points), 0)
        light = lights_world[view]
        shading = (light[0] + normal @ light[1:]).clamp_min(0)
        images.append((albedo * shading[..., None]).movedim(-1, 0))
        depths.append(depth)
        normals.append(normal)
        albedos.append(albedo)
    depth = torch.stack(depths)
    normals_world = torch.stack(normals)
    directed = torch.einsum("vhwc,vc->vhw", normals_world, lights_world[:, 1:])
    shading = lights_world[:, 0, None, None] + directed
    return RenderedScene(
        views=_views(torch.stack(images), cameras),
        cameras=cameras,
        lights_world=lights_world,
        depth=depth,
        normals_world=normals_world,
        albedo=torch.stack(albedos),
        foreground=depth.isfinite(),
        lit=(shading > 0) & depth.isfinite(),
        highlight=torch.zeros_like(depth, dtype=torch.bool),
    )


def render_objects(
    objects: Sequence[SceneObject],
    cameras: Cameras,
    lights: Lights,
    generator: torch.Generator,
    sensor: SensorConfig | None = None,
) -> RenderedScene:
    """Ray trace meshes under point lights, all photographs in memory; float32.

    Light falls off with the square of the distance and is stopped by every object; highlights
    are those of :mod:`pimper_torch.evidence.scenes.shading`.

    Args:
        objects: Those that are no surroundings are the foreground.
        cameras: Of one image size.
    """
    sensor = SensorConfig() if sensor is None else sensor
    stage = Stage(objects)
    frames = [
        render_frame(stage, cameras, lights, view, generator, sensor)
        for view in range(cameras.num_views)
    ]
    return RenderedScene(
        views=_views(torch.stack([frame.image for frame in frames]), cameras),
        cameras=cameras,
        lights_world=lights.harmonics_world(cameras.centers_world),
        depth=torch.stack([frame.depth for frame in frames]),
        normals_world=torch.stack([frame.normals_world for frame in frames]),
        albedo=torch.stack([frame.albedo for frame in frames]),
        foreground=torch.stack([frame.foreground for frame in frames]),
        lit=torch.stack([frame.lit for frame in frames]),
        highlight=torch.stack([frame.highlight for frame in frames]),
        mesh=stage.mesh,
    )


def _rays(cameras: Cameras, view: int) -> Float[Tensor, "height width 3"]:
    width, height = (int(side) for side in cameras.sizes_px[view])
    pixels = pixel_centers(width, height, like=cameras.intrinsics)
    rays = rays_through(
        pixels.reshape(-1, 2), cameras.cam_from_world[view], cameras.intrinsics[view]
    )
    return rays.reshape(height, width, 3)


def _views(images: Float[Tensor, "view channel height width"], cameras: Cameras) -> Views:
    names = tuple(f"view_{view:02d}.png" for view in range(cameras.num_views))
    return Views(
        images=images.float(),
        sizes_px=cameras.sizes_px,
        names=names,
        focals_px=torch.full((cameras.num_views,), torch.nan),
    )
