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
    """Imperfections of a sensor.

    Attributes:
        supersample: Rays per pixel, along each side, where neighbouring pixels differ; one ray
            elsewhere.
        read_noise: Standard deviation in the dark; 1 is saturation.
        shot_noise: Additional variance due to light, as a fraction of its radiance.
        exposure: Factor on radiance before saturation at 1.
    """

    supersample: Annotated[int, Range(least=1, most=16)] = 2
    read_noise: Annotated[float, Range(least=0, most=1)] = 0.002
    shot_noise: Annotated[float, Range(least=0, most=1)] = 0.0001
    exposure: Annotated[float, Range(above=0, most=1000)] = 1.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        require_ranges(self)


def expose(
    radiance: Float[Tensor, "channel height width"],
    generator: torch.Generator,
    sensor: SensorConfig,
) -> Float[Tensor, "channel height width"]:
    """Add noise and saturate.

    Args:
        radiance: Already multiplied by the exposure, unbounded.
    """
    spread = (sensor.read_noise**2 + sensor.shot_noise * radiance).sqrt()
    noise = torch.randn(radiance.shape, generator=generator, dtype=radiance.dtype)
    return (radiance + spread * noise).clamp(0, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """Settings of a rendered scene.

    Attributes:
        num_views: Number of photographs.
        lights_per_pose: Number of photographs from every camera pose, each under a different
            light; poses are then folders.
        width: Pixels.
        height: Pixels.
        seed: Of everything random: shape, texture, point light, camera shake and noise.
        path: Of the camera: along an arc, once around at one height (the object is rotated), or
            handheld around the object at three heights.
        span_deg: Of the arc.
        elevation_deg: Mean height of the camera over the table's plane.
        sway_deg: Amplitude of the camera's elevation along the arc.
        fill: Fraction of the image filled by the object, along the tighter side.
        fixed_point_light: The point light is fixed relative to the camera, as when the object
            rotates; only with the turntable. Otherwise, it moves between photographs.
        constant_light: All photographs have the light of the first, as when the lamp is fixed
            relative to the object and only the camera moves.
        fixed_room: A patterned floor and wall behind the object, fixed relative to the camera;
            only with the turntable. Otherwise, there is nothing beyond the table.
        fixed_table: The table is also fixed relative to the camera, and only the object rotates;
            only with the turntable. Otherwise, it rotates with the object.
        turned_over: In the second half of the photographs, the object is upside down on its table,
            so that its underside is visible. The world is the object's frame in both halves; not
            if anything else is fixed relative to the camera.
        pan_jitter_px: The camera pans and tilts on its tripod between photographs, so the image
            of static things shifts by up to this many pixels from its intended
            position; the object stays in the image, smaller.
        crop_jitter_px: The image is cropped with its centre off by up to this many pixels.
        light: A near point light, with fall-off over the object, or a distant one.
        point_light_distance: Of the near point light, in object sizes; up to a quarter nearer or
            farther.
        irradiance: Of the point light, as the radiance of a white surface facing it; up to a
            quarter more or less.
        ambient: Uniform light, as the radiance of a white surface; up to a quarter more or less.
        window: Soft light from one side, static in the world, as the radiance of a white surface
            facing it; 0 for none.
        lamp_colour: Variation of the point light's colour between photographs: the standard
            deviation of the logarithm of each channel; 0 is white.
        exposure: Factor on radiance; values above 1 saturate.
        read_noise: Standard deviation of the sensor in the dark; 1 is saturation.
        shot_noise: Additional variance due to light, as a fraction of its radiance.
        supersample: Rays per pixel, along each side, where pixels differ from their neighbours.
        bits: Of a sample in the photographs.
        encoding: sRGB, as written by cameras, or samples proportional to radiance.
        table: Its texture: cloth is modest, patterned has many features everywhere, plain
            has none.
        up: The axis of a mesh file that points up.
        rotation_deg: Of the object about the vertical axis, counter-clockwise seen from above.
        albedo: Linear red, green and blue, uniform over the object; by default its texture.
        specular: Reflectance of the surface at normal incidence, 0 is matte; by default the
            scene's, and 0 for a mesh file.
        roughness: Of the highlight, 0.1 polished to 0.5 satin; by default the scene's, and
            0.3 for a mesh file.
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
        """Refuse settings that give no photographs."""
        require_ranges(self)
        _ = self.sensor  # checks its own settings
        # Rays of a photograph take 100 bytes each: 64 GB.
        rays = int((640_000_000 / (self.width * self.height)) ** 0.5)
        moving = self.turned_over or self.fixed_point_light or self.jitter_px > 0
        shared = self.num_views % self.lights_per_pose == 0
        lowest, highest = self.elevation_deg - self.sway_deg, self.elevation_deg + self.sway_deg
        on_axis = self.path == "turntable"
        turning = f"path turntable instead of {self.path}, for anything fixed to the camera"
        widest = 0.3 * min(self.width, self.height)
        jitter = f"0 or more, both jitters together at most {widest:.0f}, 0.3 of the tighter side"
        for valid, name, needed in (
            (
                self.supersample <= rays,
                "supersample",
                f"at most {rays} with {self.width} x {self.height} pixels; or fewer of these",
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
                f"between 2 and 85 after adding or subtracting sway_deg, {self.sway_deg}",
            ),
            (on_axis or not self.fixed_point_light, "fixed_point_light", turning),
            (on_axis or not self.fixed_room, "fixed_room", turning),
            (on_axis or not self.fixed_table, "fixed_table", turning),
            (
                not self.turned_over or (self.num_views >= 2 and not self._has_fixed),
                "turned_over",
                "at least 2 views, no window, and nothing fixed to the camera",
            ),
            (0 <= self.crop_jitter_px <= widest, "crop_jitter_px", jitter),
            (self.pan_jitter_px >= 0 and self.jitter_px <= widest, "pan_jitter_px", jitter),
            (
                not (self.constant_light and self.fixed_point_light),
                "constant_light",
                "no fixed_point_light, with which the light moves around the object",
            ),
            (
                self.irradiance + self.ambient + self.window > 0,
                "irradiance",
                "light from irradiance, ambient or window",
            ),
            (
                all(0 <= channel <= 1 for channel in self.albedo or ()),
                "albedo",
                "between 0 and 1 in every channel",
            ),
        ):
            require(valid, name, getattr(self, name), needed)

    @property
    def _has_fixed(self) -> bool:
        """Whether anything is fixed in the room while the object moves."""
        fixed = self.fixed_point_light or self.fixed_room or self.fixed_table
        return fixed or self.window > 0

    @property
    def jitter_px(self) -> float:
        """Maximum displacement of the image, pan and crop together."""
        return self.pan_jitter_px + self.crop_jitter_px

    @property
    def sensor(self) -> SensorConfig:
        """Settings of the sensor."""
        return SensorConfig(
            supersample=self.supersample,
            read_noise=self.read_noise,
            shot_noise=self.shot_noise,
            exposure=self.exposure,
        )
