"""Results in the layouts of other programs."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.doors.camera_files.transforms_json import FLIP
from pimper_torch.doors.exchange.alicevision import write_alicevision
from pimper_torch.doors.exchange.colmap_workspace import write_workspace
from pimper_torch.doors.exchange.map_files import write_maps
from pimper_torch.doors.exchange.nerfstudio import write_nerfstudio
from pimper_torch.doors.exchange.result import Result
from pimper_torch.doors.io.reports import write_json
from pimper_torch.records.priors import Axes
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.progress import part


def write_lights(result: Result, folder: Path) -> None:
    """Write the direction to every view's light as ``lights.lp``, and all of it as JSON.

    The first line of ``lights.lp`` counts the others, which are a name and a unit vector in the
    frame of the reference camera: x right, y up, z to the viewer. A view whose light has no
    direction, or is unknown, is in ``lights.json`` alone. Blanks in names become ``_`` in
    ``lights.lp``.
    """
    names = result.scene.views.names
    reference = names.index(result.reference)
    directions = directions_world(result)
    rotation = FLIP[:, None] * result.cameras.cam_from_world[reference, :3, :3]
    seen = directions @ rotation.mT
    known = directions.isfinite().all(dim=1)
    if not bool(known.any()):
        raise InputError(
            "no view's light has a direction, so there are no lights to export; needed: some in "
            "lights.json. Leave the format `lights` out."
        )
    lines = [
        " ".join(["_".join(name.split()), *(f"{value:.9f}" for value in towards.tolist())])
        for name, towards, told in zip(names, seen, known.tolist(), strict=True)
        if told
    ]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "lights.lp").write_text("\n".join([str(len(lines)), *lines, ""]), encoding="utf-8")
    lights = directions.new_full((len(names), 4), torch.nan)
    lights = lights if result.lights_world is None else result.lights_world
    about = {
        "reference": result.reference,
        "model": "radiance = albedo * (l[0] + l[1:] . n), world frame, n outward",
        "in_reference": "unit, towards the light, x right, y up, z to the viewer",
        "views": [
            {
                "name": name,
                "light": _numbers(light),
                "direction_world": _numbers(direction),
                "direction_in_reference": _numbers(towards),
            }
            for name, light, direction, towards in zip(names, lights, directions, seen, strict=True)
        ],
    }
    write_json(about, folder / "lights.json")


def directions_world(result: Result) -> Float[Tensor, "view 3"]:
    """Return unit vectors towards every view's light, world frame; NaN where there is none."""
    if result.lights_world is None:
        return torch.full((result.scene.views.num_views, 3), torch.nan, dtype=torch.float64)
    directed = result.lights_world[:, 1:]
    there = (directed != 0).any(dim=1, keepdim=True)
    return torch.where(there, normalize(directed, dim=1), torch.nan)


def _numbers(values: Float[Tensor, " value"]) -> list[float] | None:
    return values.tolist() if bool(values.isfinite().all()) else None


Format = Literal["colmap", "nerfstudio", "alicevision", "maps", "lights"]


def write_formats(
    result: Result, formats: Sequence[Format], folder: Path | str, axes: Axes = "opengl"
) -> None:
    """Write a result in some layouts, each in a folder of its name.

    Args:
        axes: That normals of ``maps`` have.
    """
    writers: Mapping[Format, Callable[[Result, Path], None]] = {
        "colmap": write_workspace,
        "nerfstudio": write_nerfstudio,
        "alicevision": write_alicevision,
        "maps": lambda result, folder: write_maps(result, folder, axes),
        "lights": write_lights,
    }
    chosen = list(dict.fromkeys(formats))
    for index, name in enumerate(chosen):
        with part(index, len(chosen)):
            writers[name](result, Path(folder) / name)
