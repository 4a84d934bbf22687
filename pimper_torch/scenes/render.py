"""Photographs computed from geometry, light and texture, with the truth beside them.

:func:`render_shape` obeys first-order lighting exactly, so that what a stage gets wrong is
the stage's own fault. :func:`render_bodies` does not: near light, cast and attached
shadows, highlights, noise and saturation are what photographs have.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.config import require
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, Mesh, Record, Views
from pimper_torch.scenes.lights import Lights
from pimper_torch.scenes.meshes import join
from pimper_torch.scenes.rendered import RenderedScene
from pimper_torch.scenes.shapes import Shape

Texture = Callable[[Float[Tensor, "*batch 3"]], Float[Tensor, "*batch channel"]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Body:
    """A mesh and what it is made of.

    Attributes:
        mesh: World.
        texture: Albedo at points of the world.
        gloss: Strength of a highlight on top of the matte part; 0 is wholly matte.
        sharpness: Exponent of the highlight.
    """

    mesh: Mesh
    texture: Texture
    gloss: float = 0.0
    sharpness: float = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorConfig:
    """How radiance becomes a photograph.

    Attributes:
        supersample: Rays a pixel, along each side.
        read_noise: Standard deviation in the dark; 1 is saturation.
        shot_noise: Variance that light adds, as a share of its radiance.
    """

    supersample: int = 2
    read_noise: float = 0.002
    shot_noise: float = 0.0001

    def __post_init__(self) -> None:
        """Refuse what no sensor does."""
        require(self.supersample >= 1, "supersample", self.supersample, "1 or more")
        require(self.read_noise >= 0, "read_noise", self.read_noise, "0 or more")
        require(self.shot_noise >= 0, "shot_noise", self.shot_noise, "0 or more")


def render_shape(
    shape: Shape, cameras: Cameras, lights_world: Float[Tensor, "view 4"], texture: Texture
) -> RenderedScene:
    """Photograph a closed form so that ``J = albedo * max(0, l . (1, n))`` holds exactly.

    One ray through every pixel's centre; no cast shadows, noise, fall-off or saturation.
    Precision is that of the cameras.
    """
    images, depths, normals, albedos = [], [], [], []
    for view in range(cameras.num_views):
        center, rays = cameras.centers_world[view], _rays(cameras, view, 0.5, 0.5)
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
    )


def render_bodies(
    bodies: Sequence[Body],
    cameras: Cameras,
    lights: Lights,
    generator: torch.Generator,
    sensor: SensorConfig | None = None,
) -> RenderedScene:
    """Ray trace meshes under point lights; float32.

    Diffuse light falls off with the square of the distance and is stopped by every body;
    highlights follow Blinn and Phong; there is no interreflection.

    Args:
        bodies: The first is the foreground.
        cameras: Of one image size.
        lights: One a view.
        generator: Of the sensor's noise.
        sensor: ``None`` is the default one.
    """
    sensor = SensorConfig() if sensor is None else sensor
    stage = _Stage(bodies)
    side = sensor.supersample
    offsets = [(step + 0.5) / side for step in range(side)]
    seen, images = [], []
    for view in range(cameras.num_views):
        eye = cameras.centers_world[view].float()
        samples = [
            stage.shade(stage.trace(eye, _rays(cameras, view, du, dv).float()), eye, lights, view)
            for dv in offsets
            for du in offsets
        ]
        radiance = torch.stack(samples).mean(dim=0).movedim(-1, 0)
        images.append(_expose(radiance, generator, sensor))
        central = stage.trace(eye, _rays(cameras, view, 0.5, 0.5).float())
        seen.append((central, stage.lit(central, lights.positions_world[view].float())))
    return RenderedScene(
        views=_views(torch.stack(images), cameras),
        cameras=cameras,
        lights_world=lights.harmonics_world(cameras.centers_world),
        depth=torch.stack([spots.depth for spots, _ in seen]),
        normals_world=torch.stack([spots.normals for spots, _ in seen]),
        albedo=torch.stack([spots.albedo for spots, _ in seen]),
        foreground=torch.stack([spots.body == 0 for spots, _ in seen]),
        lit=torch.stack([lit for _, lit in seen]),
        mesh=stage.mesh,
    )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Spots(Record):
    """What rays meet; depth is infinite, normal and albedo zero, body -1 for a miss."""

    depth: Float[Tensor, "height width"]
    points: Float[Tensor, "height width 3"]
    normals: Float[Tensor, "height width 3"]
    albedo: Float[Tensor, "height width channel"]
    body: Int[Tensor, "height width"]


class _Stage:
    """Bodies, ready to be looked at."""

    def __init__(self, bodies: Sequence[Body]) -> None:
        self.bodies = bodies
        self.mesh = join(*(body.mesh for body in bodies))
        self._caster = RayCaster(self.mesh.vertices_world, self.mesh.faces)
        self._normals = vertex_normals(self.mesh.vertices_world, self.mesh.faces).float()
        counts = torch.tensor([len(body.mesh.faces) for body in bodies])
        self._ends = torch.cumsum(counts, dim=0)
        extent = self.mesh.vertices_world.amax(dim=0) - self.mesh.vertices_world.amin(dim=0)
        # Clear of the surface in embree's float32, yet below what a pixel shows.
        self._clearance = 2e-4 * float(extent.norm())

    def trace(self, eye: Float[Tensor, " 3"], rays: Float[Tensor, "height width 3"]) -> _Spots:
        """Look along rays."""
        hits = self._caster.cast(eye, rays)
        hit = hits.face >= 0
        points = eye + torch.where(hit, hits.distance, 1)[..., None] * rays
        body = torch.where(hit, torch.bucketize(hits.face, self._ends, right=True), -1)
        rows, owner = points.reshape(-1, 3), body.reshape(-1)
        albedo = rows.new_zeros(len(rows), 0)
        for index, one in enumerate(self.bodies):
            (own,) = torch.nonzero(owner == index, as_tuple=True)
            found = one.texture(rows[own])
            if index == 0:
                albedo = rows.new_zeros(len(rows), found.shape[-1])
            albedo = albedo.index_add(0, own, found)
        return _Spots(
            depth=hits.distance,
            points=points,
            normals=normalize(hits.interpolate(self._normals, self.mesh.faces), dim=-1),
            albedo=albedo.reshape(*body.shape, -1),
            body=body,
        )

    def lit(self, spots: _Spots, lamp: Float[Tensor, " 3"]) -> Bool[Tensor, "height width"]:
        """Tell where a lamp is above the surface's horizon and no body is in between."""
        start = spots.points + self._clearance * spots.normals
        toward = lamp - start
        facing = (spots.body >= 0) & ((spots.normals * toward).sum(dim=-1) > 0)
        lit = torch.zeros_like(facing)
        lit[facing] = self._caster.cast(start[facing], toward[facing]).distance >= 1
        return lit

    def shade(
        self, spots: _Spots, eye: Float[Tensor, " 3"], lights: Lights, view: int
    ) -> Float[Tensor, "height width channel"]:
        """Give the radiance that reaches the eye."""
        lamp, target = lights.positions_world[view].float(), lights.target_world.float()
        gloss = spots.points.new_tensor([body.gloss for body in self.bodies])[spots.body]
        sharpness = spots.points.new_tensor([body.sharpness for body in self.bodies])[spots.body]
        to_eye = normalize(eye - spots.points, dim=-1)
        diffuse = lights.ambient[view].float().expand_as(gloss)
        highlight = torch.zeros_like(gloss)
        sources = [(lamp, float(lights.irradiance[view]), self.lit(spots, lamp))]
        if lights.flash[view] > 0:
            sources.append((eye, float(lights.flash[view]), spots.body >= 0))
        for place, irradiance, lit in sources:
            toward = place - spots.points
            distance = toward.norm(dim=-1, keepdim=True)
            toward = toward / distance
            falloff = ((place - target).norm() / distance[..., 0]) ** 2
            arriving = torch.where(lit, irradiance * falloff, 0)
            cosine = (spots.normals * toward).sum(dim=-1).clamp_min(0)
            half = normalize(toward + to_eye, dim=-1)
            mirror = (spots.normals * half).sum(dim=-1).clamp_min(0)
            diffuse = diffuse + arriving * cosine
            highlight = highlight + arriving * cosine.sign() * gloss * mirror**sharpness
        radiance = spots.albedo * diffuse[..., None] + highlight[..., None]
        return torch.where((spots.body >= 0)[..., None], radiance, 0)


def _rays(
    cameras: Cameras, view: int, along_u: float, along_v: float
) -> Float[Tensor, "height width 3"]:
    width, height = (int(side) for side in cameras.sizes_px[view])
    shift = cameras.intrinsics.new_tensor([along_u, along_v]) - 0.5
    pixels = pixel_centers(width, height, like=cameras.intrinsics) + shift
    rays = rays_through(
        pixels.reshape(-1, 2), cameras.cam_from_world[view], cameras.intrinsics[view]
    )
    return rays.reshape(height, width, 3)


def _expose(
    radiance: Float[Tensor, "channel height width"],
    generator: torch.Generator,
    sensor: SensorConfig,
) -> Float[Tensor, "channel height width"]:
    spread = (sensor.read_noise**2 + sensor.shot_noise * radiance).sqrt()
    noise = torch.randn(radiance.shape, generator=generator, dtype=radiance.dtype)
    return (radiance + spread * noise).clamp(0, 1)


def _views(images: Float[Tensor, "view channel height width"], cameras: Cameras) -> Views:
    names = tuple(f"view_{view:02d}.png" for view in range(cameras.num_views))
    return Views(
        images=images.float(),
        sizes_px=cameras.sizes_px,
        names=names,
        focals_px=torch.full((cameras.num_views,), torch.nan),
    )
