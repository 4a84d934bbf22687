"""Results in the layouts of other programs."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import torch
from torch.nn.functional import normalize

from pimper_torch.doors.camera_files.transforms_json import FLIP
from pimper_torch.doors.exchange.alicevision import write_alicevision
from pimper_torch.doors.exchange.colmap_workspace import write_workspace
from pimper_torch.doors.exchange.map_files import write_maps
from pimper_torch.doors.exchange.nerfstudio import write_nerfstudio
from pimper_torch.doors.exchange.result import Result
from pimper_torch.records.priors import Axes
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.progress import part


def write_lights(result: Result, folder: Path) -> None:
    """Write the direction to every view's light as ``lights.lp``.

    The first line counts the others, which are a name and a unit vector in the frame of the
    reference camera: x right, y up, z to the viewer. A view whose light has no direction, or is
    unknown, is left out. Blanks in names become ``_``.
    """
    names = result.scene.views.names
    lights = result.lights_world
    directed = torch.zeros(len(names), 3).double() if lights is None else lights[:, 1:]
    rotation = result.cameras.cam_from_world[names.index(result.reference), :3, :3]
    seen = normalize(directed, dim=1) @ (FLIP[:, None] * rotation).mT
    lines = [
        " ".join(["_".join(name.split()), *(f"{value:.9f}" for value in towards.tolist())])
        for name, towards in zip(names, seen, strict=True)
        if bool(towards.isfinite().all() & (towards != 0).any())
    ]
    if not lines:
        raise InputError(
            "no view's light has a direction, so there are no lights to export; needed: some in "
            "lights.json. Leave the format `lights` out."
        )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "lights.lp").write_text("\n".join([str(len(lines)), *lines, ""]), encoding="utf-8")


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
