"""Export of results in the formats of other programs."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

from pimper_torch.export.alicevision import write_alicevision
from pimper_torch.export.colmap_workspace import write_workspace
from pimper_torch.export.map_files import write_maps
from pimper_torch.export.nerfstudio import write_nerfstudio
from pimper_torch.export.result import Result, WrittenResult
from pimper_torch.export.rti import write_rti
from pimper_torch.records.priors import Axes
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.progress import part

Format = Literal["colmap", "nerfstudio", "alicevision", "maps", "rti"]

WITH_PHOTOGRAPHS: Mapping[str, Callable[[Result, Path], None]] = {
    "colmap": write_workspace,
    "nerfstudio": write_nerfstudio,
    "alicevision": write_alicevision,
}
"""Writers of the formats that contain photographs."""


def write_formats(
    result: WrittenResult, formats: Sequence[Format], folder: Path | str, axes: Axes = "opengl"
) -> None:
    """Write a result in several formats, each in a folder named after it.

    Args:
        result: With its photographs, if one of the formats contains them.
        axes: Axes of the normals of ``maps``.

    Raises:
        InputError: A format contains photographs, and the result was read without them.
    """
    chosen = list(dict.fromkeys(formats))
    for index, name in enumerate(chosen):
        subfolder = Path(folder) / name
        with part(index, len(chosen)):
            if name == "maps":
                write_maps(result, subfolder, axes)
            elif name == "rti":
                write_rti(result, subfolder)
            elif isinstance(result, Result):
                WITH_PHOTOGRAPHS[name](result, subfolder)
            else:
                raise InputError(
                    f"{name} contains photographs, but the result was read without them; needed: a "
                    "result of `read_result`."
                )
