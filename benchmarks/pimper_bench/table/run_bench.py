"""Runs of all methods on all scenes, with one evaluation."""

import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import torch

from pimper_bench.metrics.evaluation import Evaluation, evaluate
from pimper_bench.metrics.in_view import Meeting, ViewFigures, figures_of, meet_truth
from pimper_bench.metrics.similarity import transfer
from pimper_bench.table.bench_inputs import (
    BenchConfig,
    Inputs,
    Method,
    MethodRun,
    method_named,
    prepare,
    scene_folder,
)
from pimper_bench.table.bench_table import (
    BenchRow,
    Table,
    markdown,
    row_of_failure,
    with_published,
    write_json,
)
from pimper_bench.table.contact_sheet import (
    MethodPanels,
    SceneRow,
    draw_sheet,
    method_panels,
    scene_row,
)
from pimper_bench.table.measure import peak_memory, this_machine
from pimper_bench.truth import Capture
from pimper_torch.export.result_folder.folders import written_whole
from pimper_torch.io.meshes import write_ply
from pimper_torch.records import Mesh
from pimper_torch.runtime.errors import PimperError, PimperWarning
from pimper_torch.runtime.reporting import stage

BENCH_NAMES = ("table.md", "table.json", "sheet.png", "meshes")


class _Cell(NamedTuple):
    """The result of a method on a scene.

    Attributes:
        mesh: Its surface in the frame of the truth; ``None`` if it failed.
        met: Intersections of the reference view's rays; ``None`` without faces.
    """

    row: BenchRow
    panels: MethodPanels
    mesh: Mesh | None = None
    met: Meeting | None = None


def run_bench(
    config: BenchConfig,
    folder: Path | str,
    *,
    overwrite: bool = False,
    cache: Path | str | None = None,
) -> Table:
    """Run methods on scenes, and write the table, its images and all surfaces to a folder.

    ==================  ===========================================================
    file                content
    ==================  ===========================================================
    `table.md`          the table, with the published figures
    `table.json`        the same with all digits, and why figures are missing
    `sheet.png`         photograph, true normals, each method's normals and errors
    `meshes/`           every surface, in the frame of the truth, as PLY
    ==================  ===========================================================

    A method that fails, or is not installed, has a row with the reason. If interrupted after the
    first scene, the completed scenes are written.

    Args:
        cache: Folder in which models of structure from motion are cached between runs.
    """
    methods = {Path(name).stem: method_named(name) for name in config.chosen_methods}
    folder = Path(folder)
    rows: list[BenchRow] = []
    sheet_rows: list[SceneRow] = []
    with (
        written_whole(folder, "table", overwrite=overwrite) as staging,
        tempfile.TemporaryDirectory(prefix="pimper_bench_") as workspace,
    ):
        (staging / "meshes").mkdir()
        for scene in config.scenes:
            try:
                measured, pictured = _scene(scene, methods, config, Path(workspace), staging, cache)
            except KeyboardInterrupt:
                if not rows:
                    raise
                warnings.warn(
                    f"interrupted in scene {scene}; completed scenes are in {folder}.",
                    PimperWarning,
                    stacklevel=2,
                )
                break
            rows += measured
            sheet_rows += pictured
        table = Table(
            rows=with_published(rows),
            machine=this_machine(),
            date=datetime.now(UTC).strftime("%Y-%m-%d"),
            scale=config.scale,
            settings={"masks": config.masks, "cameras": config.cameras, "seed": config.seed},
        )
        write_json(table, staging / "table.json")
        (staging / "table.md").write_text(markdown(table) + "\n", encoding="utf-8")
        if sheet_rows:
            draw_sheet(sheet_rows, staging / "sheet.png")
    return table


def _scene(
    scene: str,
    methods: dict[str, Method],
    config: BenchConfig,
    workspace: Path,
    staging: Path,
    cache: Path | str | None,
) -> tuple[list[BenchRow], list[SceneRow]]:
    """Run all methods on a scene; if its cameras fail, all rows have the reason."""
    name = Path(scene).stem
    with stage(f"{name} render"):
        rendered = scene_folder(scene, config, workspace)
    try:
        with stage(f"{name} sfm"):
            inputs = prepare(rendered, config, cache)
    except PimperError as error:
        return [row_of_failure(name, method, error) for method in methods], []
    cells = []
    for method, run in methods.items():
        with stage(f"{name} {method}"):
            cells.append(_cell(name, method, run, inputs, config, staging))
    panels = tuple(cell.panels for cell in cells)
    return _with_common(cells, inputs.maps), [scene_row(name, inputs, panels)]


def _with_common(cells: Sequence[_Cell], maps: Capture) -> list[BenchRow]:
    """Return the rows of a scene with figures over the pixels that all methods cover.

    A method that skips difficult parts has small errors on the rest. Methods without a
    surface are ignored.

    Args:
        maps: The truth in the reference view.
    """
    masks = [cell.met.both for cell in cells if cell.met is not None]
    common = reduce(torch.logical_and, masks) if masks else None
    rows = []
    for row, _, mesh, met in cells:
        if common is not None and mesh is not None and met is not None:
            shared = met.only(common)
            view = figures_of(shared, mesh, maps, 0) if bool(common.any()) else None
            figures = {f"common_{name}": value for name, value in _along_rays(view).items()}
            row = row.replace(common_percent=100 * shared.coverage, **figures)
        rows.append(row)
    return rows


def _along_rays(view: ViewFigures | None) -> dict[str, Any]:
    """Return the figures that a row has both over its covered pixels and over common ones."""
    if view is None:
        return {}
    normals, shape = view.transferred_normals, view.shape_normals
    return {
        "relative_error": view.relative_error,
        "mean_normal_deg": normals.mean_deg if normals else None,
        "median_normal_deg": normals.median_deg if normals else None,
        "mean_shape_normal_deg": shape.mean_deg if shape else None,
        "median_shape_normal_deg": shape.median_deg if shape else None,
    }


def _cell(
    scene: str, method: str, run: Method, inputs: Inputs, config: BenchConfig, staging: Path
) -> _Cell:
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
        return _Cell(row, MethodPanels(method=method, note=row.note))
    mesh = transfer(outcome.estimate.mesh, evaluation.alignment.truth_from_world)
    write_ply(mesh, staging / "meshes" / f"{scene}_{method}.ply")
    # If the view was evaluated, its rays meet the surface.
    met = meet_truth(mesh, inputs.maps, 0) if evaluation.views else None
    row = _row_of(scene, method, outcome, evaluation, memory, sfm_minutes)
    return _Cell(row, method_panels(mesh, met, inputs, method), mesh, met)


def _counted(figures: Mapping[str, int | float]) -> dict[str, Any]:
    """Return the counts of a preset's stages; baselines have none."""
    names = ("mesh_points", "triangles", "samples")
    counts: dict[str, Any] = {name: int(figures[name]) for name in names if name in figures}
    if counts:
        counts["missing_percent"] = 100 * (figures["missing_samples"] / figures["samples"])
    return counts


def _row_of(
    scene: str,
    method: str,
    outcome: MethodRun,
    evaluation: Evaluation,
    memory: float | None,
    sfm_minutes: float | None,
) -> BenchRow:
    view = evaluation.views[0] if evaluation.views else None
    surface = evaluation.surface
    seen = surface.seen if surface else None
    shape = view.shape_normals if view else None
    return BenchRow(
        scene=scene,
        method=method,
        minutes=outcome.seconds / 60,
        sfm_minutes=sfm_minutes,
        coverage_percent=100 * view.coverage if view else None,
        pitted_percent=shape.pitted_percent if shape else None,
        chamfer=seen.chamfer_mean_percent if seen else None,
        accuracy=surface.accuracy.mean_percent if surface and surface.accuracy else None,
        completeness=surface.whole.completeness.mean_percent if surface and surface.whole else None,
        completeness_seen=seen.completeness.mean_percent if seen else None,
        f_scores=tuple((score.threshold_percent, 100 * score.f_score) for score in seen.thresholds)
        if seen
        else (),
        peak_memory_mb=memory,
        **_counted(outcome.counts),
        **_along_rays(view),
    )
