"""``pimper convert``: conversion of data sets between layouts."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from pimper_bench import datasets
from pimper_bench.truth import Capture, Truth
from pimper_torch.cli.arguments import Flag, read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.export.nerfstudio import point_subset
from pimper_torch.export.result_folder.folders import prepare_output, require_apart, written_whole
from pimper_torch.radiometry import FROM_FILES, LINEAR, Encoding
from pimper_torch.radiometry.encoding import ResponseChoice, SaturationChoice
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.reporting import stage

Source = Literal[
    "colmap",
    "llff",
    "idr",
    "transforms",
    "camera-file",
    "dtu-points",
    "dtu-mvs",
    "diligent-mv",
    "rendered",
]
Target = Literal["colmap", "idr", "transforms"]


_PHOTOGRAPHS = ("response", "saturation", "black")


def _named(name: str) -> object:
    return tyro.conf.arg(name=f"photographs.{name}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadOptions:
    """Options of readers; each applies to some layouts.

    Attributes:
        scan: Number of the scene or scan; required for the DTU sets.
        images: Folder of the photographs, if it is not that of the layout.
        masks: Folder with a mask for each photograph, of the same name; black off the object.
        mesh: File of the true surface, in the data set's frame; used for the exported cloud or
            unit sphere.
        response: Like photographs.response of `pimper reconstruct`; the layout's by default.
        saturation: Like photographs.saturation of `pimper reconstruct`.
        black: Like photographs.black of `pimper reconstruct`.
        light_seed: Keep one light at each position, selected with this seed.
        max_size_px: Maximum length of the photographs' longer side; larger ones are shrunk, with
            their cameras. 0 for no limit.
    """

    scan: int | None = None
    images: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    masks: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    mesh: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    response: Annotated[ResponseChoice | None, _named("response")] = None
    saturation: Annotated[SaturationChoice | None, _named("saturation")] = None
    black: Annotated[float | None, _named("black")] = None
    light_seed: int | None = None
    max_size_px: int = 0


_OPTIONS = tuple(field.name for field in dataclasses.fields(ReadOptions))


@dataclass(frozen=True, slots=True, kw_only=True)
class ConvertJob:
    """Read a data set in one layout and write its photographs and cameras in a different one.

    Photographs are written as 8-bit sRGB, undistorted, with pinhole cameras.

    Attributes:
        data: The data set's folder; for some layouts its file of cameras.
        out: Folder for the result; new or empty.
        source: Layout of DATA; camera-file is a file in any format supported by `--sparse`, such as
            Metashape's or Meshroom's, next to its photographs.
        target: Layout to write.
        overwrite: Replace an existing result in OUT.
        options: Options of the reader.
    """

    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DATA")]
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    source: Source
    target: Target
    overwrite: Flag = False
    options: Annotated[ReadOptions, tyro.conf.arg(name="")] = ReadOptions()


def run(job: ConvertJob, output: Output) -> None:
    """Run ``convert``: read, write atomically, and describe the result."""
    with written_whole(job.out, "data set", overwrite=job.overwrite) as staging:
        with output.observer(), stage("read") as figures:
            capture = read(job)
            figures["photographs"] = capture.views.num_views
        write(capture, job.target, staging)
    output.remark(describe(capture, job))
    output.result({"folder": job.out}, photographs=capture.views.num_views)


def checked(command: str, arguments: Sequence[str]) -> ConvertJob:
    """Read the arguments, and check everything that can be checked without reading DATA."""
    job = parse(arguments)
    inputs = {
        "DATA": job.data,
        "--images": job.options.images,
        "--masks": job.options.masks,
        "--mesh": job.options.mesh,
    }
    require_apart(job.out, inputs)
    prepare_output(job.out, "data set", job.overwrite)
    if not job.data.exists():
        raise InputError(f"{job.data}: does not exist; needed: the folder or file of a data set.")
    return job


def parse(arguments: Sequence[str]) -> ConvertJob:
    """Read the arguments of ``convert``."""
    return read_arguments(ConvertJob, "convert", arguments, levels=True)


class _Layout(NamedTuple):
    """Reader of a layout.

    Attributes:
        encoding: Encoding of its files by default; ``None`` if they specify it.
        options: Names of the supported options other than the photographs' encoding.
    """

    read: Callable[..., Capture]
    encoding: Encoding | None
    options: tuple[str, ...] = ()


def layouts() -> Mapping[Source, _Layout]:
    """Return all layouts by name."""
    posed = ("mesh", "max_size_px")
    with_folders = ("images", "masks", *posed)
    lit = ("light_seed", "max_size_px")
    return {
        "colmap": _Layout(datasets.read_colmap, FROM_FILES, with_folders),
        "llff": _Layout(datasets.read_llff, FROM_FILES, with_folders),
        "idr": _Layout(datasets.read_idr, FROM_FILES, posed),
        "transforms": _Layout(datasets.read_transforms, FROM_FILES, posed),
        "camera-file": _Layout(datasets.read_camera_file, FROM_FILES, with_folders),
        "dtu-points": _Layout(datasets.read_dtu_points, LINEAR, ("scan", *lit)),
        "dtu-mvs": _Layout(datasets.read_dtu_mvs, LINEAR, ("scan", *lit)),
        "diligent-mv": _Layout(datasets.read_diligent_mv, LINEAR, lit),
        # Without maps, for which no layout has a format; scene.json specifies the encoding.
        "rendered": _Layout(partial(datasets.read_rendered, maps=False), None),
    }


def read(job: ConvertJob) -> Capture:
    """Read the data set with the given options."""
    layout, plain = layouts()[job.source], ReadOptions()
    given = {
        name: getattr(job.options, name)
        for name in _OPTIONS
        if getattr(job.options, name) != getattr(plain, name)
    }
    supported = (*layout.options, *(_PHOTOGRAPHS if layout.encoding else ()))
    unsupported = [_option(name) for name in given if name not in supported]
    if unsupported:
        valid = [_option(name) for name in _OPTIONS if name in supported]
        raise InputError(
            f"{', '.join(unsupported)}: not supported for --source {job.source}; needed: any of "
            f"{', '.join(valid)}, or a different --source."
        )
    if "scan" in layout.options and "scan" not in given:
        raise InputError(f"--source {job.source} has several scans; needed: --scan with a number.")
    photographs = {name: given.pop(name) for name in _PHOTOGRAPHS if name in given}
    if layout.encoding is not None and photographs:
        given["encoding"] = dataclasses.replace(layout.encoding, **photographs)
    return layout.read(job.data, **given)


def write(capture: Capture, target: Target, folder: Path) -> None:
    """Write a capture's photographs and cameras in a layout."""
    if capture.cameras is None:
        raise InputError(
            "this data set has no cameras; needed: cameras to export. Its photographs can be used "
            "without conversion."
        )
    writers = {
        "colmap": datasets.write_colmap,
        "idr": datasets.write_idr,
        "transforms": datasets.write_transforms,
    }
    folder.mkdir(parents=True, exist_ok=True)
    points = cloud(capture.truth)
    writers[target](capture.views, capture.cameras, folder, points_world=points)


def cloud(truth: Truth) -> Float[Tensor, "point 3"] | None:
    """Return points of the true surface, at most 100,000; ``None`` if it is unknown."""
    points = truth.points_world if truth.mesh is None else truth.mesh.vertices_world
    return None if points is None else points[point_subset(len(points)).to(points.device)]


def describe(capture: Capture, job: ConvertJob) -> str:
    """Return a description of the data that was read and written."""
    sizes = {f"{width} x {height}" for width, height in capture.views.sizes_px.tolist()}
    size = sizes.pop() if len(sizes) == 1 else f"{len(sizes)} sizes"
    count, positions, lights = (
        len(set(numbers.tolist()))
        for numbers in (torch.arange(capture.views.num_views), capture.position, capture.light)
    )
    light = (
        "assumed to have a different light each"
        if lights == count
        else f"under {_count(lights, 'light')}"
    )
    available = [
        name.removesuffix("_world")
        for name in ("mesh", "points_world", "depth", "normals_world", "albedo", "lights_world")
        if getattr(capture.truth, name) is not None
    ]
    return (
        f"{_count(count, 'photograph')} of {size} from {_count(positions, 'position')}, {light}, "
        f"{'with' if capture.views.masks is not None else 'without'} masks; truth: "
        f"{', '.join(available) or 'none'}.\nWritten to {job.out} in the layout {job.target}."
    )


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _option(name: str) -> str:
    return f"--{'photographs.' * (name in _PHOTOGRAPHS)}{name.replace('_', '-')}"
