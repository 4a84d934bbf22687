"""Scenes by methods, measured in the same way."""

import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import reduce
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_bench.bench.bench_inputs import (
    BenchConfig,
    Inputs,
    Method,
    MethodRun,
    method_named,
    prepare,
    scene_folder,
)
from pimper_bench.bench.bench_table import (
    BenchRow,
    Table,
    markdown,
    row_of_failure,
    with_published,
    write_json,
)
from pimper_bench.bench.heatmap import (
    ErrorScale,
    MethodPanels,
    SceneRow,
    crop_to,
    draw_heatmap,
    draw_sheet,
    error_picture,
    normals_picture,
    shading_in_view,
    surface_picture,
)
from pimper_bench.bench.measure import peak_memory, this_machine
from pimper_bench.metrics.evaluation import Evaluation, evaluate
from pimper_bench.metrics.in_view import Meeting, ViewFigures, figures_of, meet_truth
from pimper_bench.metrics.similarity import transfer
from pimper_bench.metrics.surface_distances import bounding_diagonal
from pimper_bench.truth import Capture
from pimper_torch.doors.io.meshes import read_mesh, write_ply
from pimper_torch.doors.outputs.folders import written_whole
from pimper_torch.records import Mesh, StageReport
from pimper_torch.result.viz.tiles import encoded
from pimper_torch.runtime.errors import PimperError, PimperWarning
from pimper_torch.runtime.progress import listening
from pimper_torch.runtime.reporting import Observer, Silent, peak_memory_mb

Covered = Bool[Tensor, "height width"]


def with_common(
    rows: Sequence[BenchRow],
    covered: Sequence[Covered | None],
    meshes: Sequence[Path | str],
    maps: Capture,
) -> list[BenchRow]:
    """Add figures over the pixels that all methods cover to the rows of a scene.

    A method that leaves out difficult parts has small errors on the rest.

    Args:
        covered: True where rays of the view meet truth and method; ``None`` for methods
            without a surface, which limit no other.
        meshes: The surfaces as files, in the frame of the truth.
        maps: The truth in that view alone.
    """
    known = [one for one in covered if one is not None]
    if not known:
        return list(rows)
    common = reduce(torch.logical_and, known)
    return [
        row if own is None else _with_common(row, path, common, maps)
        for row, own, path in zip(rows, covered, meshes, strict=True)
    ]


def _with_common(row: BenchRow, path: Path | str, common: Covered, maps: Capture) -> BenchRow:
    mesh = read_mesh(path)
    met = meet_truth(mesh, maps, 0)
    assert met is not None  # as when it was measured
    met = met.only(common)
    fraction = 100 * met.coverage
    if not met.both.any():
        return row.replace(common_percent=fraction)
    figures = figures_of(met, mesh, maps, 0)
    others = {f"common_{name}": value for name, value in _along_rays(figures).items()}
    return row.replace(common_percent=fraction, **others)


def _along_rays(view: ViewFigures | None) -> dict[str, Any]:
    """Return the figures that a row has over its own pixels and over common ones."""
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


# Per cent of the diagonal: twice what the facets alone are off by, so that methods differ.
ERROR_SCALE = ErrorScale(clip=1.0, unit="% of the diagonal")


def method_panels(
    mesh: Mesh,
    met: Meeting | None,
    inputs: Inputs,
    scene: str,
    method: str,
    heatmap: Path | str | str,
) -> MethodPanels:
    """Draw the errors of a surface on it, and return its pictures for the sheet.

    Args:
        mesh: In the frame of the truth.
        met: Of the rays of the reference view; ``None`` if none meets it.
    """
    truth = inputs.maps
    if met is None or truth.cameras is None:
        return MethodPanels(method=method, note="points only")
    errors = error_along_rays(met, truth)
    shading = shading_in_view(mesh, truth.cameras, 0)
    draw_heatmap(errors, ERROR_SCALE, heatmap, shading=shading, title=f"{scene}, {method}")
    crop = _crop(truth)
    return MethodPanels(
        method=method,
        surface=surface_picture(mesh, truth.cameras, 0, met.hits)[crop],
        error=error_picture(errors, ERROR_SCALE, shading=shading)[crop],
    )


def scene_row(scene: str, inputs: Inputs, methods: tuple[MethodPanels, ...]) -> SceneRow:
    """Return a scene's row: photograph, truth, and the panels of all methods."""
    maps = inputs.maps
    assert maps.cameras is not None
    assert maps.truth.normals_world is not None
    crop = _crop(maps)
    taken = inputs.scene.views.images[inputs.coarse.reference]
    return SceneRow(
        scene=scene,
        photograph=encoded(taken.movedim(0, -1))[crop],
        truth=normals_picture(maps.truth.normals_world[0], maps.cameras, 0)[crop],
        methods=methods,
    )


def error_along_rays(met: Meeting, capture: Capture) -> Float[Tensor, "height width"]:
    """Return the distance of a surface from the truth along the rays of a view.

    Per cent of the diagonal of the true bounding box; infinite on the object where the surface is
    missed, NaN off the object.
    """
    assert capture.truth.mesh is not None
    error = torch.full(met.valid.shape, torch.nan, dtype=torch.float64)
    error[met.valid] = torch.inf
    distance = (met.points - met.points_true).norm(dim=-1).double()
    error[met.both] = 100 * distance / bounding_diagonal(capture.truth.mesh)
    return error


def _crop(maps: Capture) -> tuple[slice, slice]:
    assert maps.truth.foreground is not None
    return crop_to(maps.truth.foreground[0])


BENCH_NAMES = ("table.md", "table.json", "sheet.png", "heatmaps", "meshes")


_Cell = tuple[BenchRow, MethodPanels, Covered | None]
"""Row, pictures, and pixels of the reference view whose rays meet truth and surface."""


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
    file                content
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
        cache: Folder where the models of structure from motion are kept from run to run.
    """
    observer = observer or Silent()
    methods = {Path(name).stem: method_named(name) for name in config.chosen_methods}
    folder = Path(folder)
    rows: list[BenchRow] = []
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
) -> tuple[list[BenchRow], list[SceneRow]]:
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
    rows, panels, covered = zip(*cells, strict=True)
    meshes = [_mesh_file(staging, name, method) for method in methods]
    return with_common(rows, covered, meshes, inputs.maps), [scene_row(name, inputs, panels)]


def _mesh_file(folder: Path, scene: str, method: str) -> Path:
    return folder / "meshes" / f"{scene}_{method}.ply"


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
        return row, MethodPanels(method=method, note=row.note), None
    mesh = transfer(outcome.estimate.mesh, evaluation.alignment.truth_from_world)
    write_ply(mesh, _mesh_file(staging, scene, method))
    heatmap = staging / "heatmaps" / f"{scene}_{method}.png"
    # Evaluated in a view, it has been met.
    met = meet_truth(mesh, inputs.maps, 0) if evaluation.views else None
    row = row_of(scene, method, outcome, evaluation, memory=memory, sfm_minutes=sfm_minutes)
    panels = method_panels(mesh, met, inputs, scene, method, heatmap)
    return row, panels, met.both if met else None


def row_of(
    scene: str,
    method: str,
    outcome: MethodRun,
    evaluation: Evaluation,
    *,
    memory: float | None = None,
    sfm_minutes: float | None = None,
) -> BenchRow:
    """Take a row's figures from an outcome and its evaluation."""
    view = evaluation.views[0] if evaluation.views else None
    surface = evaluation.surface
    seen, missing = surface.seen if surface else None, outcome.missing_fraction
    shape = view.shape_normals if view else None
    return BenchRow(
        scene=scene,
        method=method,
        mesh_points=outcome.mesh_points,
        triangles=outcome.triangles,
        samples=outcome.samples,
        missing_percent=None if missing is None else 100 * missing,
        minutes=outcome.seconds / 60,
        sfm_minutes=sfm_minutes,
        coverage_percent=100 * view.coverage if view else None,
        pitted_percent=shape.pitted_percent if shape else None,
        chamfer=seen.chamfer_mean_percent if seen else None,
        accuracy=surface.accuracy.mean_percent if surface and surface.accuracy else None,
        completeness=surface.whole.completeness.mean_percent if surface and surface.whole else None,
        completeness_seen=seen.completeness.mean_percent if seen else None,
        f_scores=tuple((one.threshold_percent, 100 * one.f_score) for one in seen.thresholds)
        if seen
        else (),
        peak_memory_mb=memory,
        **_along_rays(view),
    )


@contextmanager
def _shown(observer: Observer, name: str) -> Iterator[None]:
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
