"""Render an object among other objects on a patterned table, along an arc.

Run as ``python benchmarks/clutter.py FOLDER [--scene jar] [--num-views 16] [--width 640]``. Writes
``photos`` and ``masks``, which are white on the object alone.
"""

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from pimper_bench.scenes.procedural_meshes import moved
from pimper_bench.scenes.render_in_memory import render_objects
from pimper_bench.scenes.scene_object import SceneObject, Texture
from pimper_bench.scenes.scene_objects import RECIPES
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.scenes.whole_scene import build_scene
from pimper_torch.radiometry import srgb_from_linear

# Scene, size, rotation in degrees and position: behind and next to the object, not occluding it.
AROUND = (
    ("potatoes", 0.7, 40, (-2.1, 0.3)),
    ("balls", 0.7, -30, (2.2, 0.4)),
    ("jar", 0.9, 0, (-1.3, 2.6)),
    ("mug", 0.8, 70, (1.4, 2.7)),
    ("potatoes", 0.5, 0, (0.2, 2.2)),
)


@dataclass(frozen=True)
class Placed:
    """A texture that is turned, resized and shifted with its object."""

    texture: Texture
    scale: float
    turn_deg: float
    shift: tuple[float, float]

    def __call__(self, points: Tensor) -> Tensor:
        """Return the albedo at points of the world."""
        own = (points - points.new_tensor([*self.shift, 0.0])) / self.scale
        cosine, sine = math.cos(math.radians(self.turn_deg)), math.sin(math.radians(self.turn_deg))
        x, y, z = own.unbind(dim=-1)
        return self.texture(torch.stack([cosine * x + sine * y, cosine * y - sine * x, z], dim=-1))


def things() -> Iterator[SceneObject]:
    """List the surrounding objects."""
    generator = torch.Generator().manual_seed(7)
    for name, scale, turn_deg, shift in AROUND:
        for item in RECIPES[name](generator):
            mesh = moved(item.mesh, scale=scale, rotation_deg=turn_deg, shift=(*shift, 0.0))
            assert item.texture is not None
            texture = Placed(item.texture, scale, turn_deg, shift)
            yield replace(item, mesh=mesh, texture=texture, surroundings=True)


def main() -> None:
    """Write photographs and masks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scene", default="jar")
    parser.add_argument("--num-views", type=int, default=16)
    parser.add_argument("--width", type=int, default=640)
    options = parser.parse_args()
    config = SceneConfig(
        num_views=options.num_views,
        width=options.width,
        height=options.width * 3 // 4,
        fill=0.6,
        table="patterned",
        elevation_deg=22.0,
    )
    scene = build_scene(options.scene, config)
    rendered = render_objects(
        [*scene.objects, *things()], scene.cameras, scene.lights, scene.noise(0), config.sensor
    )
    encoded = (255 * srgb_from_linear(rendered.views.images)).round().byte()
    for kind, pictures in (
        ("photos", encoded.movedim(1, -1)),
        ("masks", 255 * rendered.foreground.byte()),
    ):
        (options.folder / kind).mkdir(parents=True, exist_ok=True)
        for name, picture in zip(scene.names, pictures.numpy(), strict=True):
            Image.fromarray(picture).save(options.folder / kind / name)


if __name__ == "__main__":
    main()
