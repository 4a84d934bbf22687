"""Image stack for reflectance transformation imaging (RTI): one viewpoint under many lights."""

from collections.abc import Mapping
from pathlib import Path

import torch
from PIL import Image

from pimper_torch.export.result import WrittenResult
from pimper_torch.geometry.directions import even_directions
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.transforms_json import FLIP
from pimper_torch.radiometry import to_bytes
from pimper_torch.records import Materials, ViewLights
from pimper_torch.runtime.progress import track
from pimper_torch.stages.relighting.held_out import shaded
from pimper_torch.stages.relighting.lit_surface import LitSurface

# Of directions evenly over the sphere, those more than 15 degrees above the image plane: lower
# lights mostly cast shadows. A choice; the polynomial of a PTM has 6 unknowns per pixel.
_LIGHTS, _OF_DIRECTIONS = 60, 162


def write_rti(result: WrittenResult, folder: Path) -> None:
    """Write images of the surface in the reference view under a dome of lights.

    The images ``light_00.jpg``, ``light_01.jpg``, ... are predictions with cast shadows, and black
    off the surface. The first line of ``lights.lp`` is their number; the others have the name of
    an image and the unit vector to its light: x right, y up, z to the viewer. Names are sorted, as
    programs match either by name or by order. The material is that of ``summary.json`` if it has
    exactly one; otherwise the surface is matte.

    Source: parseLP in relight's ``src/lp.cpp``, which reads lines of four words.
    """
    camera = result.mesh_cameras.take([result.names.index(result.reference)])
    surface = LitSurface(result.mesh)
    pixels, material = surface.pixels(camera), _material(result)
    towards = even_directions(_OF_DIRECTIONS)[:_LIGHTS]
    towards_world = (towards * FLIP).float() @ camera.cam_from_world[0, :3, :3]
    width, height = camera.sizes_px[0].tolist()
    dark = torch.zeros(1, pixels.base_color.shape[1])
    folder.mkdir(parents=True)
    files = [f"light_{index:02d}.jpg" for index in range(_LIGHTS)]
    for file, direction in zip(track(files), towards_world, strict=True):
        light = ViewLights(
            direction_world=direction[None],
            inverse_distance=torch.zeros(1),
            ambient=dark,
            directed=dark + 1,
        )
        picture = torch.zeros(height * width, 3)
        picture[pixels.pixel] = shaded(surface, pixels, light, material).clamp(0, 1)
        levels = to_bytes(picture).reshape(height, width, 3).numpy()
        Image.fromarray(levels).save(folder / file, quality=100, subsampling=0)
    lines = [
        " ".join([file, *(f"{value:.9f}" for value in direction)])
        for file, direction in zip(files, towards.tolist(), strict=True)
    ]
    text = "\n".join([str(_LIGHTS), *lines, ""])
    (folder / "lights.lp").write_text(text, encoding="ascii")


def _material(result: WrittenResult) -> Materials | None:
    relighting = result.summary.get("relighting")
    materials = relighting.get("materials") if isinstance(relighting, Mapping) else None
    if not isinstance(materials, list) or len(materials) != 1:
        return None
    file = DataSetPath(Path("summary.json"), "a result of `pimper reconstruct`")
    (material,) = file.objects(materials, "materials")
    entries = [material.get(name) for name in ("metallic", "roughness", "specular")]
    values = file.numbers(entries, 3, "metallic, roughness and specular")
    everywhere = torch.zeros(len(result.mesh.vertices_world), dtype=torch.long)
    return Materials.of(everywhere, values[None].float())
