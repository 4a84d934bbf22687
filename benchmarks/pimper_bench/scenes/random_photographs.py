"""Photographs of a random scene, as a camera stores them, and their maps."""

import io
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from PIL import Image
from torch import Tensor
from torch.nn.functional import conv2d, pad

from pimper_bench.scenes.random_draws import Draws
from pimper_bench.scenes.random_rooms import Room
from pimper_bench.scenes.ray_tracing import TracedObjects, noticeable, steepness
from pimper_bench.scenes.scene_lights import PointLight
from pimper_bench.scenes.scene_settings import SensorConfig, expose
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.radiometry import linear_from_srgb, srgb_from_linear
from pimper_torch.records import Cameras, Record

NOTHING, OBJECT, TABLE, ROOM = -1, 0, 1, 2
# At most this fraction of the pixels has four rays, and none that differs by less in the square
# root of radiance from those next to it.
_FINE, _UNEVEN = 0.07, 0.04


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Seen(Record):
    """What rays meet.

    Attributes:
        depth: In lengths of the rays; infinite for nothing.
        normals: Unit, outward; zero for nothing.
        surface: ``OBJECT``, ``TABLE``, ``ROOM`` or ``NOTHING``.
        lit: True where the lamp is visible from the object or its table.
        highlight: As of :class:`.RenderedFrame`, before exposure.
    """

    radiance: Float[Tensor, "*batch channel"]
    albedo: Float[Tensor, "*batch channel"]
    depth: Float[Tensor, "*batch"]
    normals: Float[Tensor, "*batch 3"]
    surface: Int[Tensor, "*batch"]
    lit: Bool[Tensor, "*batch"]
    highlight: Bool[Tensor, "*batch"]


def render_view(
    stage: TracedObjects,
    room: Room | None,
    world_from_room: Float[Tensor, "4 4"],
    cameras: Cameras,
    view: int,
    light: PointLight,
) -> Seen:
    """Ray trace one photograph without a sensor; float32.

    One ray through each pixel's centre, whose depth and surface are returned, and the mean
    radiance of four where neighbours differ most.
    """
    pose, intrinsics = cameras.cam_from_world[view], cameras.intrinsics[view]
    eye = cameras.centers_world[view].float()
    width, height = (int(side) for side in cameras.sizes_px[view])
    centers = pixel_centers(width, height, like=intrinsics).reshape(-1, 2)

    def seen_at(pixels: Float[Tensor, "pixel 2"]) -> Seen:
        rays = rays_through(pixels, pose, intrinsics).float()
        return _seen(stage, room, world_from_room.float(), eye, rays, light)

    seen = seen_at(centers)
    (uneven,) = torch.nonzero(_uneven(seen.radiance.reshape(height, width, 3)), as_tuple=True)
    offsets = torch.tensor([[-0.25, -0.25], [-0.25, 0.25], [0.25, -0.25], [0.25, 0.25]])
    fine = torch.cat([centers[uneven] + offset for offset in offsets.to(centers)])
    mean = seen_at(fine).radiance.reshape(4, -1, 3).mean(dim=0)
    flat = seen.replace(radiance=seen.radiance.index_copy(0, uneven, mean))
    rasters = {each.name: getattr(flat, each.name) for each in fields(flat)}
    return Seen(**{name: v.reshape(height, width, *v.shape[1:]) for name, v in rasters.items()})


def _seen(
    stage: TracedObjects,
    room: Room | None,
    world_from_room: Float[Tensor, "4 4"],
    eye: Float[Tensor, " 3"],
    rays: Float[Tensor, "ray 3"],
    light: PointLight,
) -> Seen:
    spots = stage.trace(eye, rays)
    met = spots.object_index >= 0
    (rows,) = torch.nonzero(met, as_tuple=True)
    shaded = stage.shade(spots.take(rows), eye, light)
    radiance = torch.zeros_like(spots.albedo).index_copy(0, rows, shaded.matte + shaded.mirrored)
    albedo, depth = spots.albedo.clone(), spots.hits.distance.clone()
    surface = torch.full_like(spots.object_index, NOTHING)
    surface[rows] = stage.outside[spots.object_index[rows]].long()
    normals, lit, highlight = spots.normals.clone(), torch.zeros_like(met), torch.zeros_like(met)
    lit[rows] = shaded.lit
    highlight[rows] = noticeable(shaded.mirrored.mean(dim=-1), shaded.matte.mean(dim=-1))
    (free,) = torch.nonzero(~met, as_tuple=True)
    if room is not None and len(free):
        room_from_world = invert_rigid(world_from_room)
        start, along = transform(room_from_world, eye[None])[0], rotate(room_from_world, rays[free])
        distance, inward = room.seen(start, along)
        points = start + distance[:, None] * along
        normals[free] = rotate(world_from_room, inward)
        received = _received(light, transform(world_from_room, points), normals[free])
        if room.glow is not None:
            received = torch.full_like(received, room.glow)
        albedo[free] = room.texture(points).expand(-1, 3)
        radiance[free] = albedo[free] * received
        depth[free], surface[free] = distance, ROOM
    return Seen(
        radiance=radiance,
        albedo=albedo,
        depth=depth,
        normals=normals,
        surface=surface,
        lit=lit,
        highlight=highlight,
    )


def _received(
    light: PointLight, points: Float[Tensor, "ray 3"], normals: Float[Tensor, "ray 3"]
) -> Float[Tensor, "ray 3"]:
    """Return the irradiance of a wall, without shadows."""
    toward, arriving = light.arriving(points)
    direct = arriving * (normals * toward).sum(dim=-1).clamp_min(0)
    colour = torch.ones(3) if light.colour is None else light.colour
    soft = torch.full_like(direct, light.ambient) + light.from_window(normals)
    return soft[:, None] + direct[:, None] * colour


def _uneven(radiance: Float[Tensor, "height width 3"]) -> Bool[Tensor, " pixel"]:
    """Return the pixels that differ most from one next to them, row by row."""
    most = steepness(radiance)
    rank = max(1, round((1 - _FINE) * most.numel()))
    return most > max(_UNEVEN, float(most.kthvalue(rank).values))


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """A camera's sensor and files.

    Attributes:
        noise: Standard deviation near saturation; a third of it in the dark.
        blur_px: Standard deviation of a Gaussian blur; 0 for none.
        quality: Of JPEG; ``None`` for files without loss.
    """

    noise: float
    blur_px: float
    quality: int | None


def random_sensor(draws: Draws) -> Sensor:
    """Draw a sensor: a third of them blur, and half of them store JPEG."""
    noise, blur_px, quality = (
        draws.log_uniform(0.001, 0.006),
        draws.uniform(0.3, 0.9),
        draws.integer(70, 95),
    )
    return Sensor(
        noise=noise,
        blur_px=blur_px if draws.chance(1 / 3) else 0.0,
        quality=quality if draws.chance(0.5) else None,
    )


def blurred(
    radiance: Float[Tensor, "channel height width"], sigma_px: float
) -> Float[Tensor, "channel height width"]:
    """Blur a photograph by a Gaussian."""
    if sigma_px == 0:
        return radiance
    steps = torch.arange(-3, 4).to(radiance)
    weights = (-0.5 * (steps / sigma_px) ** 2).exp()
    weights = weights / weights.sum()
    padded = pad(radiance[:, None], (3, 3, 3, 3), mode="replicate")
    return conv2d(conv2d(padded, weights[None, None, None]), weights[None, None, :, None])[:, 0]


def stored(
    radiance: Float[Tensor, "channel height width"], sensor: Sensor, generator: torch.Generator
) -> Float[Tensor, "channel height width"]:
    """Add noise, encode to 8-bit sRGB, compress, and return what is read back: linear radiance."""
    noise = SensorConfig(read_noise=sensor.noise / 3, shot_noise=8 / 9 * sensor.noise**2)
    exposed = expose(radiance, generator, noise)
    samples = (255 * srgb_from_linear(exposed.movedim(0, -1))).round().numpy().astype(np.uint8)
    if sensor.quality is not None:
        file = io.BytesIO()
        Image.fromarray(samples).save(file, format="JPEG", quality=sensor.quality)
        samples = np.asarray(Image.open(file)).copy()
    return linear_from_srgb(torch.from_numpy(samples).float() / 255).movedim(-1, 0).contiguous()
