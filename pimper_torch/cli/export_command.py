"""``pimper export``: write a result in the formats of other programs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pimper_torch.cli.arguments import Flag, read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.export.result_folder.folders import prepare_output, require_apart, written_whole
from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import InputError

# The same as in `write_formats`; type checkers compare them.
Format = Literal["colmap", "nerfstudio", "alicevision", "maps", "rti"]
Axes = Literal["opengl", "opencv", "lub"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportJob:
    """Write a result in the formats of other programs, each in its own folder in OUT.

    Maps and photographs are undistorted, for pinhole cameras.

    Attributes:
        result: Folder written by `pimper reconstruct`.
        out: Folder for the formats; new or empty.
        formats: One or more: `colmap` (dense workspace: depth and normal maps), `nerfstudio`
            (transforms.json with masks and depths, also for Brush), `alicevision` (.sfm with
            normals and albedo, for Meshroom and Open-RNb), `maps` (normals, depth and albedo as
            EXR, PNG and NPZ), `rti` (the reference view under 60 lights, with lights.lp).
        axes: Axes of normals in `maps`: `opengl` (right, up, to the viewer), `opencv` (right, down,
            into the scene) or `lub` (left, up, to the viewer).
        photos: Folder of the photographs, if they were moved; not needed for `maps` and `rti`.
        overwrite: Replace an earlier export in OUT.
    """

    result: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULT")]
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    formats: Annotated[tuple[Format, ...], tyro.conf.arg(name="format", metavar="FORMAT")]
    axes: Axes = "opengl"
    photos: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    overwrite: Flag = False


def run(job: ExportJob, output: Output) -> None:
    """Run ``export``: read the result, and write all formats or none."""
    from pimper_torch.export.layouts import WITH_PHOTOGRAPHS, write_formats
    from pimper_torch.export.result import read_result, read_written
    from pimper_torch.runtime.reporting import stage

    with output.observer(), written_whole(job.out, "data set", overwrite=job.overwrite) as staging:
        with stage("read") as figures:
            needed = any(name in WITH_PHOTOGRAPHS for name in job.formats)
            result = read_result(job.result, job.photos) if needed else read_written(job.result)
            figures["photographs"] = len(result.names) if needed else 0
        with stage("write"):
            write_formats(result, job.formats, staging, job.axes)
    paths: dict[str, Path] = {name: job.out / name for name in job.formats}
    output.remark("\n".join(f"{path} is the result as {name}." for name, path in paths.items()))
    output.result({"folder": job.out, **paths}, photographs=len(result.names))


def checked(command: str, arguments: Sequence[str]) -> ExportJob:
    """Return the arguments, after all checks that do not read RESULT."""
    job = read_arguments(ExportJob, command, arguments)
    require(len(job.formats) > 0, "--format", "nothing", "one or more formats")
    require_apart(job.out, {"RESULT": job.result, "--photos": job.photos})
    if job.out.resolve().is_relative_to(job.result.resolve()):
        raise InputError(
            f"{job.out}: is in RESULT ({job.result}), which must contain only its own files. "
            "Choose a different folder."
        )
    prepare_output(job.out, "data set", job.overwrite)
    if not job.result.is_dir():
        raise InputError(
            f"{job.result}: is not a folder; needed: a folder written by `pimper reconstruct`."
        )
    return job
