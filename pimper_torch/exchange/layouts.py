"""Results in the layouts of other programs."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

from pimper_torch.exchange.alicevision import write_alicevision
from pimper_torch.exchange.colmap_workspace import write_workspace
from pimper_torch.exchange.light_positions import write_lights
from pimper_torch.exchange.map_files import write_maps
from pimper_torch.exchange.nerfstudio import write_nerfstudio
from pimper_torch.exchange.result import Result
from pimper_torch.progress import part
from pimper_torch.records.priors import Axes

Format = Literal["colmap", "nerfstudio", "alicevision", "maps", "lights"]


def write_formats(
    result: Result, formats: Sequence[Format], folder: Path | str, axes: Axes = "opengl"
) -> None:
    """Write a result in some layouts, each in a folder of its name.

    Args:
        folder: Holds none of them.
        axes: That normals of ``maps`` have.

    Raises:
        InputError: The result lacks what a layout is made of.
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
