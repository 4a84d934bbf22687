"""``pimper evaluate``: a result compared with ground truth, on the terminal and as JSON."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from rich.console import Console
from rich.text import Text

from pimper_bench.datasets.diligent import read_diligent_mv
from pimper_bench.datasets.dtu_sets import read_dtu_mvs, read_dtu_protocol
from pimper_bench.datasets.rendered import read_rendered
from pimper_bench.metrics.compared_page import write_compared_page
from pimper_bench.metrics.estimates import Estimate, read_estimate
from pimper_bench.metrics.evaluation import (
    EvaluateConfig,
    Evaluation,
    chosen_views,
    evaluate,
)
from pimper_bench.metrics.figure_rows import report, rows
from pimper_bench.metrics.other_poses import warn_of_other_poses
from pimper_bench.metrics.similarity import transfer
from pimper_bench.metrics.surface_distances import true_surface
from pimper_bench.truth import Capture, DtuProtocol, Truth
from pimper_torch.cli.arguments import Flag, read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.export.result_folder.files import file_written_whole, prepare_file
from pimper_torch.io.meshes import read_mesh
from pimper_torch.io.version import installed_version
from pimper_torch.records import Views
from pimper_torch.runtime.config import to_mapping
from pimper_torch.runtime.errors import InputError
from pimper_torch.viz.report.page import HEAD

Layout = Literal["auto", "rendered", "mesh", "dtu-mvs", "diligent-mv"]

# The number of the camera position in names of the DTU and DiLiGenT-MV sets.
_POSITION = re.compile(r"(?:rect|view)_(\d+)")
FORMAT = "pimper_torch evaluation"
_DEFAULT = EvaluateConfig()


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateJob:
    """Measure a result against ground truth, each figure by a named convention.

    Attributes:
        result: Folder that `pimper reconstruct` wrote, or a mesh of any method.
        truth: Folder of a rendered scene or of a data set, or a mesh.
        out: JSON file for all figures.
        report: HTML file that displays the result and its errors in a browser; needs the
            photographs of the result at their original path.
        overwrite: Replace existing files of an earlier evaluation, but no other files.
        truth_layout: Type of TRUTH. `mesh`: a mesh file or point cloud in the result's frame;
            `rendered`: a folder that `pimper render` wrote; `dtu-mvs`: the folder of the
            DTU multi-view stereo set, with its protocol if it contains ObsMask;
            `diligent-mv`: an object's folder. `auto` distinguishes the first two.
        scan: Number of the scan of `dtu-mvs`.
        config: Settings of the evaluation.
    """

    result: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULT")]
    truth: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="TRUTH")]
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    report: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    overwrite: Flag = False
    truth_layout: Layout = "auto"
    scan: int | None = None
    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = _DEFAULT


def run(job: EvaluateJob, output: Output) -> None:
    """Run ``evaluate``."""
    config = job.config
    estimate = read_estimate(job.result)
    capture, maps, protocol = read_truth(job, estimate, config)
    evaluation = evaluate(estimate, capture, config, maps=maps, dtu=protocol)
    if evaluation.surface is not None:
        moved = transfer(estimate.mesh, evaluation.alignment.truth_from_world)
        warn_of_other_poses(moved, capture, config.seen_from)
    relighting = read_relighting(job.result)
    if not output.as_json:
        show(evaluation, Console(), relighting)
    _prepare_files(job)
    if job.out is not None:
        write_report(evaluation, job, relighting)
        output.remark(f"{job.out} contains all figures.")
    if job.report is not None:
        _write_page(evaluation, capture, job.result, job.report)
        output.remark(f"{job.report} displays the errors.")
    files = {"figures": job.out, "report": job.report}
    paths = {name: path for name, path in files.items() if path is not None}
    output.result(paths, figures={**report(evaluation), "relighting": relighting})


def checked(command: str, arguments: Sequence[str]) -> EvaluateJob:
    """Read the arguments, and check what can be checked without reading RESULT and TRUTH."""
    job = read_arguments(EvaluateJob, command, arguments)
    for path in (job.result, job.truth):
        if not path.exists():
            raise InputError(f"{path}: does not exist; needed: a result, and its ground truth.")
    _prepare_files(job)
    return job


def read_truth(
    job: EvaluateJob, estimate: Estimate, config: EvaluateConfig
) -> tuple[Capture, Capture | None, DtuProtocol | None]:
    """Return the truth, separate maps of the compared views if it has none, and its protocol.

    Only the maps of compared views of a rendered scene are read, so that memory does not
    grow with the number of its views.
    """
    layout, truth = job.truth_layout, job.truth
    if layout == "auto":
        layout = "rendered" if (truth / "truth").is_dir() else "mesh"
        if layout == "mesh" and truth.is_dir():
            raise InputError(
                f"{truth}: is a folder without truth/; needed: a folder that `pimper render` "
                "wrote, a mesh file, or the layout of a data set (--truth-layout)."
            )
    if layout == "mesh":
        return mesh_capture(truth), None, None
    if layout == "rendered":
        without_maps = read_rendered(truth, maps=False, photographs=False)
        chosen = chosen_views(estimate, without_maps, config)
        return without_maps, read_rendered(truth, views=chosen, photographs=False), None
    if layout == "diligent-mv":
        return named_as(read_diligent_mv(truth, lights=[1]), estimate), None, None
    scan = job.scan
    if scan is None:
        raise InputError(f"{truth}: has several scans; needed: --scan with the number of one.")
    # The photographs are not compared; shrunk ones save a gigabyte.
    capture = read_dtu_mvs(truth, scan, lights=[0], max_size_px=200)
    protocol = read_dtu_protocol(truth, scan) if (truth / "ObsMask").is_dir() else None
    return named_as(capture, estimate), None, protocol


def named_as(capture: Capture, estimate: Estimate) -> Capture:
    """Rename views to the estimate's names of the same positions, under any light.

    Names of these sets contain the position (``rect_007_3_r5000.png``, ``view_07/012.png``), and a
    result may use any light of each. A position that the estimate has several times, or not at all,
    keeps its name.
    """
    positions = [_position_in(name) for name in estimate.names]
    name_of: dict[int | None, str] = {
        position: name
        for position, name in zip(positions, estimate.names, strict=True)
        if position is not None and positions.count(position) == 1
    }
    names = tuple(name_of.get(_position_in(name), name) for name in capture.views.names)
    return capture.replace(views=capture.views.replace(names=names))


def _position_in(name: str) -> int | None:
    match = _POSITION.search(name)
    return int(match[1]) if match else None


def mesh_capture(path: Path) -> Capture:
    """Read a mesh or a point cloud as ground truth without photographs."""
    mesh = read_mesh(path)
    points = None if len(mesh.faces) else mesh.vertices_world
    empty = torch.zeros(0, dtype=torch.long)
    return Capture(
        views=Views(
            images=torch.zeros(0, 3, 1, 1),
            sizes_px=torch.zeros(0, 2, dtype=torch.long),
            names=(),
            focals_px=torch.zeros(0),
        ),
        cameras=None,
        truth=Truth(mesh=mesh if points is None else None, points_world=points),
        position=empty,
        light=empty,
    )


def read_relighting(result: Path) -> dict[str, Any] | None:
    """Read a result's errors in photographs; ``None`` if it has none."""
    try:
        summary = json.loads((result / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    relighting: dict[str, Any] | None = summary.get("relighting")
    return relighting


def show(
    evaluation: Evaluation, console: Console, relighting: dict[str, Any] | None = None
) -> None:
    """Print the figures by section, with their meanings next to or below them."""
    sections = rows(evaluation, relighting)
    lines = [row for _, section in sections for row in section]
    first = 2 + max(len(row.name) for row in lines)
    second = first + 2 + max(len(row.value) for row in lines)
    in_line = console.width >= second + 72
    for title, section in sections:
        console.print(Text(title, style="bold"), soft_wrap=True)
        for row in section:
            text = Text(f"  {row.name}".ljust(first) + f"  {row.value}")
            if in_line:
                text.pad_right(second + 2 - len(text))
            else:
                text.append("\n" + " " * (first + 2))
            text.append(row.meaning, style="dim")
            console.print(text, soft_wrap=True)


def write_report(
    evaluation: Evaluation, job: EvaluateJob, relighting: dict[str, Any] | None = None
) -> None:
    """Write all figures, and the settings of the evaluation, as JSON, atomically."""
    assert job.out is not None
    content = {
        "format": FORMAT,
        "pimper_torch": installed_version(),
        "result": str(job.result),
        "truth": str(job.truth),
        "settings": {"truth_layout": job.truth_layout, "scan": job.scan, **to_mapping(job.config)},
        **report(evaluation),
        "relighting": relighting,
    }
    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    with file_written_whole(job.out) as fresh:
        fresh.write_text(text, encoding="utf-8")


def _write_page(evaluation: Evaluation, capture: Capture, result: Path, path: Path) -> None:
    """Write the page of a result with its errors, atomically."""
    mesh = true_surface(capture)
    with file_written_whole(path) as fresh:
        write_compared_page(result, mesh, evaluation.alignment.truth_from_world, fresh)


def _prepare_files(job: EvaluateJob) -> None:
    """Refuse to replace files that are not from an evaluation."""
    marks = {job.out: f'"format": "{FORMAT}"', job.report: HEAD}
    for path, mark in marks.items():
        if path is not None:
            prepare_file(path, job.overwrite, mark)
