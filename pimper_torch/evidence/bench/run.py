"""Scenes by methods, measured in the same way."""

import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import torch

from pimper_torch.errors import PimperError, PimperWarning
from pimper_torch.evidence.bench.common import Covered, with_common
from pimper_torch.evidence.bench.config import BenchConfig
from pimper_torch.evidence.bench.inputs import Inputs, prepare, scene_folder
from pimper_torch.evidence.bench.machine import this_machine
from pimper_torch.evidence.bench.memory import peak_memory
from pimper_torch.evidence.bench.methods import Method, Outcome, method_named
from pimper_torch.evidence.bench.panels import ERROR_SCALE, method_panels, scene_row
from pimper_torch.evidence.bench.rows import Row, Table, row_of_failure, with_published, write_json
from pimper_torch.evidence.bench.table import markdown
from pimper_torch.evidence.metrics.alignment import transfer
from pimper_torch.evidence.metrics.evaluate import Evaluation, evaluate
from pimper_torch.evidence.metrics.in_view import meet_truth
from pimper_torch.io.meshes import write_ply
from pimper_torch.outputs.folders import written_whole
from pimper_torch.progress import listening
from pimper_torch.records import Record, StageReport
from pimper_torch.reporting import Observer, Silent, peak_memory_mb
from pimper_torch.viz.heatmap import MethodPanels, SceneRow, draw_sheet

BENCH_NAMES = ("table.md", "table.json", "sheet.png", "heatmaps", "meshes")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Measured(Record):
    """One cell of the bench: a method on a scene.

    Attributes:
        covered: True where rays of the reference view meet truth and surface; ``None`` if it
            has no surface.
    """

    row: Row
    panels: MethodPanels
    covered: Covered | None = None


def run_bench(
    config: BenchConfig,
    folder: Path | str,
    *,
    observer: Observer | None = None,
    overwrite: bool = False,
    cache: Path | str | None = None,
) -> Table:
    """Run methods on scenes, and write the table, its figures and all surfaces to a folder.

    ==================  ===========================================================
    file                what
    ==================  ===========================================================
    `table.md`          the table, beside the published figures
    `table.json`        the same with all digits, and why figures are missing
    `sheet.png`         photograph, true normals, each method's normals and errors
    `heatmaps/`         errors on the surface, one picture a scene and method
    `meshes/`           every surface, in the frame of the truth, as PLY
    ==================  ===========================================================

    A method that fails, or is not installed, has a row that says so. Interrupted after the
    first scene, the scenes that are complete are written.

    Args:
        folder: New or empty.
        cache: Folder where the models of structure from motion are kept from run to run.
    """
    observer = observer or Silent()
    methods = {Path(name).stem: method_named(name) for name in config.chosen_methods}
    folder = Path(folder)
    rows: list[Row] = []
    sheet: list[SceneRow] = []
    with (
        written_whole(folder, "table", overwrite=overwrite) as staging,
        tempfile.TemporaryDirectory(prefix="pimper_bench_") as workspace,
    ):
        for part in ("heatmaps", "meshes"):
            (staging / part).mkdir()
        for scene in config.scenes:
            try:
                measured, pictures = _scene(
                    scene, methods, config, Path(workspace), staging, observer, cache
                )
            except KeyboardInterrupt:
                if not rows:
                    raise
                warnings.warn(
                    f"interrupted in scene {scene}; what was complete is in {folder}.",
                    PimperWarning,
                    stacklevel=2,
                )
                break
            rows += measured
            sheet += pictures
        table = Table(
            rows=with_published(rows),
            machine=this_machine(),
            date=datetime.now(UTC).strftime("%Y-%m-%d"),
            scale=config.scale,
            settings={"masks": config.masks, "cameras": config.cameras, "seed": config.seed},
        )
        write_json(table, staging / "table.json")
        (staging / "table.md").write_text(markdown(table) + "\n", encoding="utf-8")
        if sheet:
            draw_sheet(sheet, ERROR_SCALE, staging / "sheet.png")
    return table


def _scene(
    scene: str,
    methods: dict[str, Method],
    config: BenchConfig,
    workspace: Path,
    staging: Path,
    observer: Observer,
    cache: Path | str | None,
) -> tuple[list[Row], list[SceneRow]]:
    """Run all methods on a scene; a scene without cameras has rows that say why."""
    name = Path(scene).stem
    with _shown(observer, f"{name} render"):
        rendered = scene_folder(scene, config, workspace)
    try:
        with _shown(observer, f"{name} sfm"):
            inputs = prepare(rendered, config, cache)
    except PimperError as error:
        return [row_of_failure(name, method, error) for method in methods], []
    cells = []
    for method, run in methods.items():
        with _shown(observer, f"{name} {method}"):
            cells.append(_cell(name, method, run, inputs, config, staging))
    row = scene_row(name, inputs, tuple(cell.panels for cell in cells))
    rows = with_common(
        [cell.row for cell in cells],
        [cell.covered for cell in cells],
        [_mesh_file(staging, name, method) for method in methods],
        inputs.maps,
    )
    return rows, [row]


def _mesh_file(folder: Path, scene: str, method: str) -> Path:
    return folder / "meshes" / f"{scene}_{method}.ply"


def _cell(
    scene: str, method: str, run: Method, inputs: Inputs, config: BenchConfig, staging: Path
) -> Measured:
    """Run a method and measure what it gives."""
    began = time.perf_counter()
    sfm_minutes = inputs.sfm_seconds / 60 or None
    try:
        with peak_memory() as peak:
            outcome = run(inputs.scene, inputs.coarse)
            memory = None if outcome.external else peak()
        evaluation = evaluate(
            outcome.estimate,
            inputs.capture,
            config.evaluation,
            surface=inputs.surface,
            maps=inputs.maps,
        )
    except (PimperError, MemoryError) as error:
        minutes = (time.perf_counter() - began) / 60
        row = row_of_failure(scene, method, error, minutes=minutes, sfm_minutes=sfm_minutes)
        return Measured(row=row, panels=MethodPanels(method=method, note=row.note))
    mesh = transfer(outcome.estimate.mesh, evaluation.alignment.truth_from_world)
    write_ply(mesh, _mesh_file(staging, scene, method))
    heatmap = staging / "heatmaps" / f"{scene}_{method}.png"
    # Evaluated in a view, it has been met.
    met = meet_truth(mesh, torch.eye(4).double(), inputs.maps, 0) if evaluation.views else None
    return Measured(
        row=row_of(scene, method, outcome, evaluation, memory=memory, sfm_minutes=sfm_minutes),
        panels=method_panels(mesh, met, inputs, scene, method, heatmap),
        covered=met.both if met else None,
    )


def row_of(
    scene: str,
    method: str,
    outcome: Outcome,
    evaluation: Evaluation,
    *,
    memory: float | None = None,
    sfm_minutes: float | None = None,
) -> Row:
    """Take a row's figures from an outcome and its evaluation."""
    view = evaluation.views[0] if evaluation.views else None
    surface = evaluation.surface
    seen, missing = surface.seen if surface else None, outcome.missing_fraction
    normals, shape = (view.transferred_normals, view.shape_normals) if view else (None, None)
    return Row(
        scene=scene,
        method=method,
        mesh_points=outcome.mesh_points,
        triangles=outcome.triangles,
        samples=outcome.samples,
        missing_percent=None if missing is None else 100 * missing,
        minutes=outcome.seconds / 60,
        sfm_minutes=sfm_minutes,
        relative_error=view.relative_error if view else None,
        coverage_percent=100 * view.coverage if view else None,
        mean_normal_deg=normals.mean_deg if normals else None,
        median_normal_deg=normals.median_deg if normals else None,
        mean_shape_normal_deg=shape.mean_deg if shape else None,
        median_shape_normal_deg=shape.median_deg if shape else None,
        pitted_percent=shape.pitted_percent if shape else None,
        chamfer=seen.chamfer_mean_percent if seen else None,
        accuracy=surface.accuracy.mean_percent if surface and surface.accuracy else None,
        completeness=surface.whole.completeness.mean_percent if surface and surface.whole else None,
        completeness_seen=seen.completeness.mean_percent if seen else None,
        f_scores=tuple((one.threshold_percent, 100 * one.f_score) for one in seen.thresholds)
        if seen
        else (),
        peak_memory_mb=memory,
    )


@contextmanager
def _shown(observer: Observer, name: str) -> Iterator[None]:
    """Report a piece of work to the observer as a stage."""
    began = time.perf_counter()
    observer.started(name)
    progressed: Callable[[int, int], None] = observer.progressed
    with listening(progressed):
        yield
    observer.finished(
        StageReport(
            name=name,
            seconds=time.perf_counter() - began,
            peak_memory_mb=peak_memory_mb(),
            figures={},
        )
    )
