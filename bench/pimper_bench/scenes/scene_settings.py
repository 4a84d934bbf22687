"""Settings of rendered scenes and of their sensor."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.runtime.config import Range, require, require_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorConfig:
    """A sensor's faults.

    Attributes:
        supersample: Rays a pixel, along each side, where neighbouring pixels differ; one ray
            where they do not.
        read_noise: Standard deviation in the dark; 1 is saturation.
        shot_noise: Variance that light adds, as a fraction of its radiance.
        exposure: Radiance is multiplied by it before it saturates at 1.
    """

    supersample: Annotated[int, Range(least=1, most=16)] = 2
    read_noise: Annotated[float, Range(least=0, most=1)] = 0.002
    shot_noise: Annotated[float, Range(least=0, most=1)] = 0.0001
    exposure: Annotated[float, Range(above=0, most=1000)] = 1.0

    def __post_init__(self) -> None:
        """Refuse what no sensor does."""
        require_ranges(self)


def expose(
    radiance: Float[Tensor, "channel height width"],
    generator: torch.Generator,
    sensor: SensorConfig,
) -> Float[Tensor, "channel height width"]:
    """Add noise and saturate.

    Args:
        radiance: Already multiplied by the exposure; without limit.
    """
    spread = (sensor.read_noise**2 + sensor.shot_noise * radiance).sqrt()
    noise = torch.randn(radiance.shape, generator=generator, dtype=radiance.dtype)
    return (radiance + spread * noise).clamp(0, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """Settings of a rendered scene.

    Attributes:
        num_views: Photographs.
        lights_per_pose: Photographs that the camera takes of every pose, each under another
            light; they are in a folder a pose then.
        width: Pixels.
        height: Pixels.
        seed: Of everything random: form, texture, point light, hand and noise.
        path: Of the camera: along an arc, once round at one height (the object turned), or
            carried all round at three heights.
        span_deg: Of the arc.
        elevation_deg: Mean height of the camera over the table's plane.
        sway_deg: How far the camera goes up and down along the arc.
        fill: Fraction of the picture that the object takes, along the tighter side.
        fixed_point_light: The point light stands still beside the camera, as where the object
            turns; only with the turntable. Else it goes to another position for every photograph.
        constant_light: All photographs have the light of the first, as where a lamp stays with the
            object and the camera alone moves.
        fixed_room: A patterned floor and wall behind the object, which stand still before the
            camera; only with the turntable. Else there is nothing beyond the table.
        fixed_table: The table stands still before the camera, too, and the object alone turns;
            only with the turntable. Else it turns with the object.
        turned_over: For the second half of the photographs the object lies upside down on its
            table, so that they show its underside. The world is the object's frame in both halves;
            not where something else stands still before the camera.
        pan_jitter_px: The camera pans and tilts on its tripod between photographs, so that the
            picture of what stands still shifts by up to so many pixels from where it is meant to
            be; the object stays in the picture, smaller.
        crop_jitter_px: The picture is cut out with its centre off by up to so many pixels.
        light: A near point light, whose light falls off over the object, or one far away.
        point_light_distance: Of the near point light, in object sizes; up to a quarter nearer or
            farther.
        irradiance: Of the point light, as the radiance of white facing it; a quarter more or less.
        ambient: Light from everywhere, as the radiance of white; a quarter more or less.
        window: Of soft light from one side of the room, at rest in the world, as the radiance of
            white facing it; 0 is none.
        lamp_colour: How much the point light's colour differs between photographs: the standard
            deviation of the logarithm of each channel; 0 is white.
        exposure: Radiance is multiplied by it; what exceeds 1 saturates.
        read_noise: Standard deviation of the sensor in the dark; 1 is saturation.
        shot_noise: Variance that light adds, as a fraction of its radiance.
        supersample: Rays a pixel, along each side, where pixels differ from their neighbours.
        bits: Of a sample in the photographs.
        encoding: sRGB as cameras write it, or samples proportional to radiance.
        table: Its texture: cloth is modest, patterned has plenty of features all over, plain
            has none.
        up: Which axis of a mesh file points up.
        rotation_deg: Of the object about the upright axis, counter-clockwise seen from above.
        albedo: Linear red, green and blue, uniform over the object; by default its texture.
        specular: Fraction of light that the object mirrors head on, 0 is matte; by default the
            scene's own, for a mesh file 0.
        roughness: Of the highlight, 0.1 polished to 0.5 satin; by default the scene's own, for
            a mesh file 0.3.
    """

    num_views: Annotated[int, Range(least=1, most=100_000)] = 30
    lights_per_pose: Annotated[int, Range(least=1, most=1000)] = 1
    width: Annotated[int, Range(least=8, most=65_535)] = 1600  # as of a JPEG
    height: Annotated[int, Range(least=8, most=65_535)] = 1200
    seed: Annotated[int, Range(least=0, most=2**32 - 1)] = 0
    path: Literal["arc", "turntable", "handheld"] = "arc"
    span_deg: Annotated[float, Range(above=0, most=360)] = 50.0
    elevation_deg: float = 30.0
    sway_deg: float = 4.0
    fill: Annotated[float, Range(least=0.1, most=1)] = 0.94
    fixed_point_light: bool = False
    constant_light: bool = False
    fixed_room: bool = False
    fixed_table: bool = False
    turned_over: bool = False
    pan_jitter_px: float = 0.0
    crop_jitter_px: float = 0.0
    light: Literal["point", "directional"] = "point"
    point_light_distance: Annotated[float, Range(least=1, most=1000)] = 2.5
    irradiance: Annotated[float, Range(least=0, most=1e12)] = 0.85
    ambient: Annotated[float, Range(least=0, most=1e12)] = 0.1
    window: Annotated[float, Range(least=0, most=1e12)] = 0.0
    lamp_colour: Annotated[float, Range(least=0, most=2)] = 0.0
    exposure: float = 1.0
    read_noise: float = 0.002
    shot_noise: float = 0.0001
    supersample: int = 2
    bits: Literal[8, 16] = 8
    encoding: Literal["srgb", "linear"] = "srgb"
    table: Literal["cloth", "patterned", "plain"] = "cloth"
    up: Literal["x", "y", "z"] = "z"
    rotation_deg: float = 0.0
    albedo: tuple[float, float, float] | None = None
    specular: Annotated[float | None, Range(least=0, most=1)] = None
    roughness: Annotated[float | None, Range(least=0, most=1)] = None

    def __post_init__(self) -> None:
        """Refuse what cannot be photographed."""
        require_ranges(self)
        _ = self.sensor  # refuses its own
        # Rays of a photograph take 100 bytes each: 64 GB.
        rays = int((640_000_000 / (self.width * self.height)) ** 0.5)
        moving = self.turned_over or self.fixed_point_light or self.jitter_px > 0
        shared = self.num_views % self.lights_per_pose == 0
        lowest, highest = self.elevation_deg - self.sway_deg, self.elevation_deg + self.sway_deg
        on_axis = self.path == "turntable"
        before = f"path turntable instead of {self.path}, for what stands still before the camera"
        widest = 0.3 * min(self.width, self.height)
        jitter = (
            f"0 or more, and both jitters together at most {widest:.0f}, 0.3 of the tighter side"
        )
        for holds, name, needed in (
            (
                self.supersample <= rays,
                "supersample",
                f"{rays} at most with {self.width} x {self.height} pixels; or fewer of these",
            ),
            (
                shared and not (self.lights_per_pose > 1 and moving),
                "lights_per_pose",
                f"a divisor of num_views ({self.num_views}), and neither turned_over, "
                "fixed_point_light nor jitter with more than 1",
            ),
            (math.isfinite(self.rotation_deg), "rotation_deg", "finite"),
            (
                self.sway_deg >= 0 and lowest >= 2 and highest <= 85,
                "elevation_deg",
                f"between 2 and 85 with {self.sway_deg} (sway_deg) taken from it or added",
            ),
            (on_axis or not self.fixed_point_light, "fixed_point_light", before),
            (on_axis or not self.fixed_room, "fixed_room", before),
            (on_axis or not self.fixed_table, "fixed_table", before),
            (
                not self.turned_over or (self.num_views >= 2 and not self._at_rest),
                "turned_over",
                "2 views or more, and no window, or anything fixed before the camera",
            ),
            (0 <= self.crop_jitter_px <= widest, "crop_jitter_px", jitter),
            (self.pan_jitter_px >= 0 and self.jitter_px <= widest, "pan_jitter_px", jitter),
            (
                not (self.constant_light and self.fixed_point_light),
                "constant_light",
                "no fixed_point_light, under which the light goes round the object",
            ),
            (
                self.irradiance + self.ambient + self.window > 0,
                "irradiance",
                "some light: irradiance, ambient or window",
            ),
            (
                all(0 <= channel <= 1 for channel in self.albedo or ()),
                "albedo",
                "between 0 and 1 in every channel",
            ),
        ):
            require(holds, name, getattr(self, name), needed)

    @property
    def _at_rest(self) -> bool:
        """Whether something stands still in the room while the object does not."""
        fixed = self.fixed_point_light or self.fixed_room or self.fixed_table
        return fixed or self.window > 0

    @property
    def jitter_px(self) -> float:
        """Return the largest error of a picture's place, of all causes together."""
        return self.pan_jitter_px + self.crop_jitter_px

    @property
    def sensor(self) -> SensorConfig:
        """The part that is the sensor's."""
        return SensorConfig(
            supersample=self.supersample,
            read_noise=self.read_noise,
            shot_noise=self.shot_noise,
            exposure=self.exposure,
        )
