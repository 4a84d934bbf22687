"""Small scenes rendered in memory, with ground truth.

:func:`render_shape` obeys first-order lighting exactly, so that any error is that of the tested
stage. :func:`render_objects` does not: it has near light, cast and attached shadows, highlights,
noise and saturation like photographs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.scenes.procedural_meshes import potato, table
from pimper_bench.scenes.ray_tracing import MAP_NAMES, TracedObjects, render_frame
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.scene_lights import Lights, wandering_lights
from pimper_bench.scenes.scene_object import SceneObject, Texture
from pimper_bench.scenes.scene_settings import SensorConfig
from pimper_bench.scenes.textures import random_speckle
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.records import Cameras, Mesh, Record, Views


@runtime_checkable
class Shape(Protocol):
    """A surface in the world."""

    def intersect(
        self, origins: Float[Tensor, "*#batch 3"], directions: Float[Tensor, "*#batch 3"]
    ) -> Float[Tensor, "*batch"]:
        """Return the distance to the first hit in lengths of the direction; infinite for a miss."""

    def normals(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Return the outward unit normals at points of the surface."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sphere:
    """A sphere."""

    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 1.0

    def intersect(
        self, origins: Float[Tensor, "*#batch 3"], directions: Float[Tensor, "*#batch 3"]
    ) -> Float[Tensor, "*batch"]:
        """Return the distance of the nearer root in front of the origin."""
        offset = origins - origins.new_tensor(self.center)
        a = (directions * directions).sum(-1)
        b = (offset * directions).sum(-1)
        c = (offset * offset).sum(-1) - self.radius**2
        discriminant = b * b - a * c
        root = discriminant.clamp_min(0).sqrt()
        near, far = (-b - root) / a, (-b + root) / a
        distance = torch.where(near > 0, near, far)
        return torch.where((discriminant >= 0) & (distance > 0), distance, torch.inf)

    def normals(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Return unit vectors away from the centre."""
        return normalize(points - points.new_tensor(self.center), dim=-1)


@dataclass(frozen=True, slots=True, kw_only=True)
class EndlessPlane:
    """An endless plane through a point; visible from both sides."""

    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def intersect(
        self, origins: Float[Tensor, "*#batch 3"], directions: Float[Tensor, "*#batch 3"]
    ) -> Float[Tensor, "*batch"]:
        """Return height over descent."""
        normal = origins.new_tensor(self.normal)
        height = ((origins - origins.new_tensor(self.point)) * normal).sum(-1)
        distance = -height / (directions * normal).sum(-1)
        return torch.where((distance > 0) & distance.isfinite(), distance, torch.inf)

    def normals(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Return the plane's normal."""
        return normalize(points.new_tensor(self.normal), dim=-1).expand_as(points)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RenderedScene(Record):
    """Photographs in memory, with ground truth; maps are as in :class:`.RenderedFrame`, per view.

    Attributes:
        lights_world: First-order light ``l`` at the object: radiance is albedo * l . (1, n). Exact
            for closed-form scenes; for ray-traced ones the light at the target, without
            fall-off, shadows and highlights.
        mesh: The ray-traced mesh; ``None`` for closed forms.
    """

    views: Views
    cameras: Cameras
    lights_world: Float[Tensor, "view 4"]
    depth: Float[Tensor, "view height width"]
    normals_world: Float[Tensor, "view height width 3"]
    albedo: Float[Tensor, "view height width channel"]
    foreground: Bool[Tensor, "view height width"]
    lit: Bool[Tensor, "view height width"]
    highlight: Bool[Tensor, "view height width"]
    mesh: Mesh | None = None


def render_shape(
    shape: Shape, cameras: Cameras, lights_world: Float[Tensor, "view 4"], texture: Texture
) -> RenderedScene:
    """Render a closed form with exactly ``J = albedo * max(0, l . (1, n))``.

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
    """Ray trace meshes under point lights, all photographs in memory, of one size; float32.

    Light decreases with the square of the distance and is occluded by every object.
    """
    sensor = SensorConfig() if sensor is None else sensor
    stage = TracedObjects(objects)
    frames = [
        render_frame(stage, cameras, lights, view, generator, sensor)
        for view in range(cameras.num_views)
    ]
    return RenderedScene(
        views=_views(torch.stack([frame.image for frame in frames]), cameras),
        cameras=cameras,
        lights_world=lights.harmonics_world(),
        **{name: torch.stack([getattr(frame, name) for frame in frames]) for name in MAP_NAMES},
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


def potato_on_table(
    seed: int = 0, *, num_views: int = 12, width: int = 640, height: int = 480
) -> RenderedScene:
    """Render a bumpy, textured potato under a point light that moves between photographs.

    The point light is two to three times the potato's length away, so its light varies over
    the object.

    Args:
        seed: Of shape, texture, lights and noise.
        num_views: On an arc at about 35 degrees over the table.
    """
    generator = torch.Generator().manual_seed(seed)
    objects = (
        SceneObject(
            mesh=potato(generator), texture=random_speckle(generator, contrast=1.5), roughness=0.35
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
        num_views, generator, distance=6.0, target=centre, toward=(0.0, -0.6, 0.8)
    )
    return render_objects(objects, cameras, lights, generator)
