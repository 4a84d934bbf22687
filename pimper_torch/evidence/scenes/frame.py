"""One photograph of a scene, with the truth about every pixel."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.evidence.scenes.lights import Lights
from pimper_torch.evidence.scenes.sensor import SensorConfig, expose
from pimper_torch.evidence.scenes.stage import Spots, Stage
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.records import Cameras, Record

# Rays worked on at once: what they need stays in the processor's cache.
_BATCH = 1 << 16
# Square roots of radiance that differ by more are sampled finely: about 4 levels of 255.
_UNEVEN = 0.015
# A highlight is noticeable from a hundredth of saturation, or a twentieth of the matte part.
_NOTICEABLE, _NOTICEABLE_FRACTION = 0.01, 0.05


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Frame(Record):
    """A photograph that no camera took, and what the rays through its pixels' centres meet.

    Attributes:
        image: Linear radiance; 1 is saturation.
        depth: Along the camera's z; infinite where the ray meets nothing.
        normals_world: Unit, outward; zero where the ray meets nothing.
        albedo: Linear; zero where the ray meets nothing.
        foreground: True on the object.
        lit: True where the point light reaches the surface.
        highlight: True where a highlight adds noticeably to the matte part: a hundredth of
            saturation or more, and a twentieth of the matte part. So does all that a conductor
            mirrors.
    """

    image: Float[Tensor, "channel height width"]
    depth: Float[Tensor, "height width"]
    normals_world: Float[Tensor, "height width 3"]
    albedo: Float[Tensor, "height width channel"]
    foreground: Bool[Tensor, "height width"]
    lit: Bool[Tensor, "height width"]
    highlight: Bool[Tensor, "height width"]


def render_frame(
    stage: Stage,
    cameras: Cameras,
    lights: Lights,
    view: int,
    generator: torch.Generator,
    sensor: SensorConfig,
) -> Frame:
    """Ray trace one photograph; float32.

    One ray through each pixel's centre; where a pixel differs from its neighbours, a grid of
    rays over its area instead.
    """
    look = _Look(stage, cameras, lights, view, sensor.exposure)
    width, height = (int(side) for side in cameras.sizes_px[view])
    centers = pixel_centers(width, height, like=cameras.intrinsics).reshape(-1, 2)
    seen = [look.at(pixels) for pixels in torch.split(centers, _BATCH)]
    radiance = torch.cat([one.radiance for one in seen])
    if sensor.supersample > 1:
        (uneven,) = torch.nonzero(_uneven(radiance.reshape(height, width, -1)), as_tuple=True)
        fine = [
            look.over(centers[rows], sensor.supersample)
            for rows in torch.split(uneven, _BATCH // 4)
        ]
        if fine:
            radiance = radiance.index_copy(0, uneven, torch.cat(fine))
    image = expose(radiance.reshape(height, width, -1).movedim(-1, 0), generator, sensor)
    object_index = torch.cat([one.spots.object_index for one in seen]).reshape(height, width)
    return Frame(
        image=image,
        depth=torch.cat([one.spots.hits.distance for one in seen]).reshape(height, width),
        normals_world=torch.cat([one.spots.normals for one in seen]).reshape(height, width, 3),
        albedo=torch.cat([one.spots.albedo for one in seen]).reshape(height, width, -1),
        foreground=(object_index >= 0) & ~stage.outside[object_index],
        lit=torch.cat([one.lit for one in seen]).reshape(height, width),
        highlight=torch.cat([one.highlight for one in seen]).reshape(height, width),
    )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Seen(Record):
    spots: Spots
    radiance: Float[Tensor, "ray channel"]
    lit: Bool[Tensor, " ray"]
    highlight: Bool[Tensor, " ray"]


class _Look:
    """One camera under one light."""

    def __init__(
        self, stage: Stage, cameras: Cameras, lights: Lights, view: int, exposure: float
    ) -> None:
        self._stage, self._exposure = stage, exposure
        self._cam_from_world = cameras.cam_from_world[view]
        self._intrinsics = cameras.intrinsics[view]
        self._eye = cameras.centers_world[view].float()
        self._point_light = lights.point_light(view)

    def at(self, pixels: Float[Tensor, "pixel 2"]) -> _Seen:
        """Look through positions in the image."""
        rays = rays_through(pixels, self._cam_from_world, self._intrinsics).float()
        spots = self._stage.trace(self._eye, rays)
        shaded = self._stage.shade(spots, self._eye, self._point_light)
        hit = (spots.object_index >= 0)[:, None]
        beyond = self._point_light.surroundings(rays)
        radiance = self._exposure * torch.where(hit, shaded.matte + shaded.mirrored, beyond)
        mirrored = self._exposure * shaded.mirrored.mean(dim=-1)
        matte = shaded.matte.mean(dim=-1)
        relative = mirrored > _NOTICEABLE_FRACTION * self._exposure * matte
        return _Seen(
            spots=spots,
            radiance=radiance,
            lit=shaded.lit,
            highlight=(mirrored > _NOTICEABLE) & relative,
        )

    def over(self, centers: Float[Tensor, "pixel 2"], side: int) -> Float[Tensor, "pixel channel"]:
        """Average the radiance over the areas of pixels."""
        steps = (torch.arange(side).to(centers) + 0.5) / side - 0.5
        offsets = torch.cartesian_prod(steps, steps)
        return torch.stack([self.at(centers + offset).radiance for offset in offsets]).mean(dim=0)


def _uneven(radiance: Float[Tensor, "height width channel"]) -> Bool[Tensor, " pixel"]:
    """Find pixels that differ from one beside, above or below them; one row an image."""
    level = radiance.clamp(0, 1).sqrt()
    marked = torch.zeros(radiance.shape[:2], dtype=torch.bool)
    across = (level[:, 1:] - level[:, :-1]).abs().amax(dim=-1) > _UNEVEN
    down = (level[1:] - level[:-1]).abs().amax(dim=-1) > _UNEVEN
    marked[:, 1:] |= across
    marked[:, :-1] |= across
    marked[1:] |= down
    marked[:-1] |= down
    return marked.reshape(-1)
