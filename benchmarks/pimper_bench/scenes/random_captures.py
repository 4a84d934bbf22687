"""Random photographs of random objects on random tables, with ground truth.

They are varied rather than typical: to train a network that finds an object's silhouette.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_bench.scenes.procedural_meshes import join
from pimper_bench.scenes.random_bodies import SIZE, Body, random_body
from pimper_bench.scenes.random_clouds import detectability, textured_cloud
from pimper_bench.scenes.random_draws import Draws
from pimper_bench.scenes.random_photographs import (
    OBJECT,
    ROOM,
    blurred,
    random_sensor,
    render_view,
    stored,
)
from pimper_bench.scenes.random_rooms import random_room
from pimper_bench.scenes.random_surfaces import random_material, random_table
from pimper_bench.scenes.random_views import random_cameras, random_lights
from pimper_bench.scenes.ray_tracing import TracedObjects
from pimper_bench.scenes.scene_object import SceneObject
from pimper_torch.records import Cameras, Mesh, Record, SparseScene, Views

_RADIUS = SIZE / 2


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RandomCapture(Record):
    """Photographs of an object on a table, and their ground truth.

    Attributes:
        views: Linear radiance as read from 8-bit sRGB files, without masks.
        cameras: Exact, float64; with a turntable, in the frame of the object.
        depth: Along the camera's z, of any surface; infinite for nothing.
        normals_world: Unit, outward; zero for nothing.
        albedo: Linear; zero for nothing.
        surface: 0 on the object, 1 on the table, 2 on the room, -1 on nothing.
        foreground: True on the object, at the pixels' centres.
        lit: True where the lamp is visible from the object or its table.
        highlight: As of :class:`.RenderedFrame`, before exposure.
        lights_world: First-order light at the object; radiance is albedo * l . (1, n).
        scene: The photographs with a cloud as of structure from motion; float32.
        mesh: The object.
        surroundings: Its table.
        family: Of the object's shape: see :class:`.Body`.
        turning: True for a turntable: the room turns relative to the object.
    """

    views: Views
    cameras: Cameras
    depth: Float[Tensor, "view height width"]
    normals_world: Float[Tensor, "view height width 3"]
    albedo: Float[Tensor, "view height width channel"]
    surface: Int[Tensor, "view height width"]
    foreground: Bool[Tensor, "view height width"]
    lit: Bool[Tensor, "view height width"]
    highlight: Bool[Tensor, "view height width"]
    lights_world: Float[Tensor, "view 4"]
    scene: SparseScene
    mesh: Mesh
    surroundings: Mesh
    family: str
    turning: bool


def render_random(
    seed: int,
    meshes: Sequence[Path | str] = (),
    *,
    num_views: int = 14,
    width: int = 480,
    height: int = 360,
) -> RandomCapture:
    """Render photographs of a random scene in memory, with ground truth.

    The same arguments give the same bits.

    Args:
        seed: Of every quantity; each part of the scene has a random stream of its own.
        meshes: Files of objects, their y axis up, of which half of the seeds use one.
        num_views: At least 3, so that points can be tracked.

    Raises:
        InputError: A file cannot be read as a mesh.
    """
    body = random_body(Draws(seed, "body"), meshes)
    mesh = join(*body.meshes)
    points = mesh.vertices_world
    path = random_cameras(Draws(seed, "cameras"), points, num_views, width, height)
    objects = _dressed(seed, body, turning=path.turning)
    cameras, stage = path.cameras, TracedObjects(objects)
    centre = (points.amin(dim=0) + points.amax(dim=0)) / 2
    lights = random_lights(Draws(seed, "lights"), cameras, centre, _RADIUS)
    reach = float((cameras.centers_world - centre).norm(dim=1).amax())
    room = random_room(Draws(seed, "room"), max(reach, 8 * _RADIUS))
    seen = [
        render_view(stage, room, path.world_from_room[view], cameras, view, lights[view])
        for view in range(num_views)
    ]
    maps = {
        name: torch.stack([getattr(item, name) for item in seen])
        for name in ("depth", "albedo", "surface", "lit", "highlight")
    }
    depth, surface = maps["depth"], maps["surface"]
    draws = Draws(seed, "sensor")
    sensor = random_sensor(draws)
    exposures = draws.vector(0.6, 1.4, num_views).float()
    clean = [
        blurred(exposure * item.radiance.movedim(-1, 0), sensor.blur_px)
        for exposure, item in zip(exposures, seen, strict=True)
    ]
    views = _views([stored(image, sensor, draws.generator) for image in clean], cameras)
    chance = [
        detectability(image, item.albedo.movedim(-1, 0), item.surface)
        for image, item in zip(clean, seen, strict=True)
    ]
    # The room of a turntable moves relative to the object.
    static = depth.where(surface != ROOM, torch.inf) if path.turning else depth
    return RandomCapture(
        views=views,
        cameras=cameras,
        **maps,
        normals_world=torch.stack([item.normals for item in seen]),
        foreground=surface == OBJECT,
        lights_world=exposures[:, None] * torch.stack([light.harmonics() for light in lights]),
        scene=textured_cloud(views, cameras, static, torch.stack(chance), Draws(seed, "cloud")),
        mesh=mesh,
        surroundings=objects[-1].mesh,
        family=body.family,
        turning=path.turning,
    )


def _dressed(seed: int, body: Body, *, turning: bool) -> list[SceneObject]:
    """Return the object's parts, of one material or of one each, and their table."""
    draws = Draws(seed, "material")
    first, shared = random_material(draws), draws.chance(0.5)
    objects = []
    for index, mesh in enumerate(body.meshes):
        material = first if shared or index == 0 else random_material(draws)
        objects.append(
            SceneObject(
                mesh=mesh,
                texture=material.texture,
                specular=material.specular,
                roughness=material.roughness,
            )
        )
    table = random_table(Draws(seed, "table"), _RADIUS, first.albedo, round_one=turning)
    return [*objects, table]


def _views(images: list[Float[Tensor, "channel height width"]], cameras: Cameras) -> Views:
    return Views(
        images=torch.stack(images),
        sizes_px=cameras.sizes_px,
        names=tuple(f"view_{view:02d}.png" for view in range(len(images))),
        focals_px=torch.full((len(images),), torch.nan),
    )
