"""Compare photographs by five strangers with those of one camera, from the same positions.

The strangers have cameras of five sizes, focal
lengths and distortions, exposures over four stops, arbitrary white balance, and people in front of
the object in every third photograph; ``alone`` has no people. All sets have the same lights, by day
and at dusk.
"""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from bench_runs import cpu_seconds, figures_of
from declared import Figures, Place, Row, Study, Table, figure, listed
from PIL import ExifTags, Image
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

import pimper_torch as pt
from pimper_bench.metrics.estimates import estimate_of
from pimper_bench.metrics.evaluation import EvaluateConfig, evaluate
from pimper_bench.scenes.render_in_memory import render_objects
from pimper_bench.scenes.scene_lights import Lights
from pimper_bench.scenes.scene_settings import SceneConfig, SensorConfig, expose
from pimper_bench.scenes.whole_scene import Scene, build_scene
from pimper_bench.truth import Capture, Truth
from pimper_torch.geometry.lens_models import undistort_pixels
from pimper_torch.geometry.pixels import grid_from_pixels, pixel_centers
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records import CameraModel, Views

RENDERED_FOCAL = 1.3  # widths of a picture that all cameras' pictures are cut from
NOISELESS = SensorConfig(read_noise=0.0, shot_noise=0.0, exposure=0.4)
SETS = {
    "one": "one camera and exposure",
    "alone": "five cameras and exposures",
    "strangers": "the same, with people in front",
}
STOPS = 2.0  # of exposure, up and down
WHITE = 0.2  # standard deviation of the logarithm of a white balance's gains
DUSK, DAY = (0.02, 0.5), (0.45, 1.0)  # ambient and lamp, as fractions of the day's lamp


@dataclass(frozen=True)
class Camera:
    """A stranger's camera.

    Attributes:
        width: Of its picture, as a fraction of the rendered one's.
        focal: Widths of its picture.
        radial: First coefficient of distortion.
        aspect: Height over width.
    """

    make: str
    width: float
    focal: float
    radial: float
    aspect: float

    def lens(self, rendered: int) -> CameraModel:
        """Return the lens in pixels, for rendered pictures of a width."""
        width = round(self.width * rendered)
        height = round(self.aspect * width)
        params = self.focal * width, width / 2, height / 2, self.radial
        return CameraModel(
            camera=0, model="SIMPLE_RADIAL", params=params, width=width, height=height
        )


CAMERAS = (
    Camera("Alpha", 0.80, 1.60, -0.08, 0.750),
    Camera("Beta", 0.72, 1.45, 0.03, 0.667),
    Camera("Gamma", 0.64, 1.50, -0.03, 0.750),
    Camera("Delta", 0.90, 1.75, 0.00, 0.667),
    Camera("Epsilon", 0.56, 1.40, -0.12, 0.750),
)


def scene_of(num_views: int, width: int) -> Scene:
    """Build the scene by day and at dusk, in turns of five photographs."""
    config = SceneConfig(
        num_views=num_views,
        width=width,
        height=width * 3 // 4,
        path="handheld",
        table="patterned",
        fill=0.62,
        irradiance=1.0,
    )
    scene = build_scene("potatoes", config)
    dusk = torch.arange(config.num_views) // 5 % 2 == 1
    ambient, lamp = torch.where(dusk[:, None], torch.tensor(DUSK), torch.tensor(DAY)).unbind(1)
    lights: Lights = scene.lights
    like = lights.ambient
    cameras = scene.cameras
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = RENDERED_FOCAL * config.width
    return Scene(
        name=scene.name,
        config=config,
        objects=scene.objects,
        cameras=cameras.replace(intrinsics=intrinsics),
        lights=lights.replace(
            ambient=ambient.to(like), irradiance=lights.irradiance * lamp.to(like)
        ),
        fixed=scene.fixed,
        world_from_room=scene.world_from_room,
    )


def taken(radiance: Tensor, lens: CameraModel, focal_px: float) -> Tensor:
    """Return the radiance in a lens's picture, cut from a rendered picture."""
    pixels = pixel_centers(lens.width, lens.height, like=radiance.double()).reshape(-1, 2)
    rays = undistort_pixels(lens, pixels)
    height, width = radiance.shape[1:]
    centre = rays.new_tensor([width / 2, height / 2])
    grid = grid_from_pixels(focal_px * rays + centre, width, height).to(radiance)
    grid = grid.reshape(1, lens.height, lens.width, 2)
    return grid_sample(radiance[None], grid, padding_mode="border", align_corners=False)[0]


def with_person(radiance: Tensor, generator: torch.Generator) -> Tensor:
    """Paint a person in clothes with folds in front of the left or right third of an image."""
    _, height, width = radiance.shape
    pixels = pixel_centers(width, height, like=radiance)
    draws = torch.rand(6, generator=generator)
    side = 0.22 if draws[0] < 0.5 else 0.78
    x = (pixels[..., 0] / height - (side + 0.1 * (draws[1] - 0.5)) * width / height) / 0.16
    y = pixels[..., 1] / height
    head = (x / 0.55) ** 2 + ((y - 0.25) / 0.11) ** 2 < 1
    body = (x.abs() < 1 - 0.4 * torch.exp(-((y - 0.38) / 0.08).square())) & (y > 0.36)
    folds = torch.randn(1, 1, 12, 16, generator=generator)
    cloth = 0.5 + 0.2 * interpolate(folds, size=(height, width), mode="bicubic")[0, 0]
    dress = draws[2:5, None, None] * cloth.clamp(0.1, 1)
    skin = radiance.new_tensor([0.55, 0.38, 0.28])[:, None, None].expand_as(radiance)
    level = radiance.mean()
    painted = torch.where(head, level * 2 * skin, level * 2 * dress.to(radiance))
    return torch.where(head | body, painted, radiance)


def write(scene: Scene, folder: Path, *, strangers: bool, people: bool) -> None:
    """Write one set of photographs."""
    folder.mkdir(parents=True)
    config, generator = scene.config, torch.Generator().manual_seed(11)
    for view in range(config.num_views):
        one = scene.cameras.take([view])
        rendered = render_objects(
            scene.objects, one, scene.lights.take([view]), generator, NOISELESS
        )
        camera = CAMERAS[view % 5 if strangers else 0]
        lens = camera.lens(config.width)
        radiance = taken(rendered.views.images[0], lens, RENDERED_FOCAL * config.width)
        stops, white = torch.rand(1, generator=generator), torch.randn(3, generator=generator)
        if strangers:
            if people and view % 3 == 1:
                radiance = with_person(radiance, generator)
            gain = 2 ** (STOPS * (2 * stops - 1)) * (WHITE * white).exp()
            radiance = radiance * gain[:, None, None]
        image = expose(radiance, generator, SensorConfig())
        samples = (255 * srgb_from_linear(image)).round().byte().movedim(0, -1).numpy()
        exif = Image.Exif()
        exif[ExifTags.Base.Make] = camera.make
        diagonal = math.hypot(lens.width, lens.height)
        equivalent = round(lens.params[0] / diagonal * math.hypot(36, 24))
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = equivalent
        Image.fromarray(samples).save(folder / f"view_{view:03d}.jpg", quality=95, exif=exif)


def measure(place: Place, name: str) -> Figures:
    """Write a set unless it exists, reconstruct it, and measure."""
    scene = scene_of(*((8, 320) if place.tiny else (20, 400)))
    folder = place.cache / "strangers" / name
    if not folder.exists():
        write(scene, folder, strangers=name != "one", people=name == "strangers")
    place.photographs(folder)
    truth = Capture(
        views=Views(
            images=torch.zeros(scene.config.num_views, 1, 1, 1),
            sizes_px=torch.ones(scene.config.num_views, 2, dtype=torch.long),
            names=scene.names,
            focals_px=torch.full((scene.config.num_views,), math.nan),
        ),
        cameras=scene.cameras,
        truth=Truth(mesh=scene.object_mesh),
        position=torch.arange(scene.config.num_views),
        light=torch.arange(scene.config.num_views),
    )
    began = cpu_seconds()
    result = pt.load_chain("default")(pt.load_views(folder))
    seconds = cpu_seconds() - began
    found = evaluate(estimate_of(result), truth, EvaluateConfig(samples=50_000, alignment="icp"))
    views = {"registered": result.scene.cameras.num_views, "CPU s": seconds}
    return figures_of(found) | views


STUDY = Study(
    name="strangers",
    rows={(told,): Row(measure=partial(measure, name=name)) for name, told in SETS.items()},
    tables=[
        Table(
            name="strangers",
            document="benchmarks/README.md",
            lines=listed(
                ["photographs"],
                [
                    figure("registered", "registered", 0),
                    figure("rotation of cameras, °", "rotation", 3),
                    figure("accuracy, %", "accuracy", 3),
                    figure("median", "accuracy, median", 3),
                    figure("completeness seen, %", "completeness", 3),
                    figure("CPU s", "CPU s", 0),
                ],
            ),
        )
    ],
)
