"""An evaluation as rows for the terminal and as plain mappings for JSON."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from torch import Tensor

from pimper_bench.metrics.camera_errors import CameraFigures, LightFigures
from pimper_bench.metrics.dtu_protocol import CAP_MM, THINNING_MM, DtuFigures
from pimper_bench.metrics.evaluation import Evaluation
from pimper_bench.metrics.in_view import AngleFigures, ViewFigures
from pimper_bench.metrics.surface_distances import (
    Calibration,
    DistanceFigures,
    SurfaceComparison,
    TwoSided,
)


class FigureRow(NamedTuple):
    """A figure for display.

    Attributes:
        name: Of the convention, as in the JSON.
        meaning: Of the figure, and the evaluated part of the result.
    """

    name: str
    value: str
    meaning: str


def report(evaluation: Evaluation) -> dict[str, object]:
    """Return all figures as plain mappings, lists and numbers; ``None`` if not finite.

    Names are those of the records. Names ending in ``_percent`` and ``_deg`` are in these
    units, other lengths in scene units of the truth, and those of ``dtu`` in millimetres.
    """
    figures = plain(evaluation)
    assert isinstance(figures, dict)
    return figures


def rows(
    evaluation: Evaluation, relighting: Mapping[str, Any] | None = None
) -> list[tuple[str, list[FigureRow]]]:
    """Return the figures as a table: its non-empty sections with their rows.

    Args:
        relighting: The entry of this name in the result's ``summary.json``.
    """
    sections: list[tuple[str, Iterator[FigureRow]]] = [("alignment", _alignment_rows(evaluation))]
    if evaluation.surface is not None:
        sections.append(("surface", _surface_rows(evaluation.surface)))
    sections += [(f"along the rays of {view.name}", _view_rows(view)) for view in evaluation.views]
    if evaluation.lights is not None:
        sections.append(("lights", _light_rows(evaluation.lights)))
    if evaluation.cameras is not None:
        sections.append(("cameras", _camera_rows(evaluation.cameras)))
    if evaluation.dtu is not None:
        sections.append(("DTU protocol", _dtu_rows(evaluation.dtu)))
    if relighting is not None:
        sections.append((f"photographs {relighting['photographs']}", _relit_rows(relighting)))
    return [(title, listed) for title, lines in sections if (listed := list(lines))]


def _alignment_rows(evaluation: Evaluation) -> Iterator[FigureRow]:
    alignment = evaluation.alignment
    yield FigureRow("method", alignment.method, alignment.description)
    value = f"{_number(alignment.scale)}, {alignment.rotation_deg:.2f}°"
    yield FigureRow("scale, rotation", value, "of the similarity from the result to the truth")
    if alignment.residual is not None:
        state = "converged" if alignment.converged else "stopped at the maximum of iterations"
        meaning = f"root mean square of the kept samples, scene units; {state}"
        yield FigureRow("residual", _number(alignment.residual), meaning)


def _surface_rows(surface: SurfaceComparison) -> Iterator[FigureRow]:
    meaning = "of the true object's bounding box, scene units; % below are relative to it"
    yield FigureRow("diagonal", _number(surface.diagonal), meaning)
    if surface.accuracy is not None:
        yield _distance_row("accuracy", surface.accuracy, "result to truth: mean; median")
    if surface.surroundings_fraction > 0:
        meaning = "of the result is nearer to the surroundings; excluded from the accuracy"
        value = _fraction(surface.surroundings_fraction)
        yield FigureRow("surroundings_fraction", value, meaning)
    if surface.whole is not None:
        yield from _two_sided_rows(surface.whole, "", "the complete truth")
    if surface.seen is not None and surface.seen_fraction is not None:
        seen = _fraction(surface.seen_fraction)
        part = f"the {seen} of it seen from {surface.seen_from} positions"
        yield from _two_sided_rows(surface.seen, " (seen)", part)
    if surface.calibration is not None:
        yield from _calibration_rows(surface.calibration, surface.diagonal)


def _calibration_rows(calibration: Calibration, diagonal: float) -> Iterator[FigureRow]:
    within = f"{_fraction(calibration.within_one)}, {_fraction(calibration.within_two)}"
    yield FigureRow(
        "expected_error",
        f"{calibration.ratio:.2f}; {within}; {calibration.rank_correlation:.2f}",
        "true over expected error, 1 if calibrated; true error within one and two "
        "expected, 68 and 95 % if calibrated; rank correlation",
    )
    for which, tenth in (("surest", calibration.bins[0]), ("least sure", calibration.bins[-1])):
        errors = (tenth.expected, tenth.root_mean_square)
        value = "; ".join(f"{_number(100 * error / diagonal)} %" for error in errors)
        meaning = "expected error; true error, root mean squares"
        yield FigureRow(f"{which} tenth", value, meaning)


def _two_sided_rows(figures: TwoSided, mark: str, part: str) -> Iterator[FigureRow]:
    meaning = f"truth to result, over {part}: mean; median"
    yield _distance_row(f"completeness{mark}", figures.completeness, meaning)
    for name, length, percent in (
        ("mean", figures.chamfer_mean, figures.chamfer_mean_percent),
        ("sum", figures.chamfer_sum, figures.chamfer_sum_percent),
    ):
        meaning = f"{name} of mean accuracy and mean completeness{mark}"
        yield FigureRow(f"chamfer_{name}{mark}", _with_percent(length, percent), meaning)
    for scores in figures.thresholds:
        meaning = (
            f"precision {_fraction(scores.precision)}, recall{mark} {_fraction(scores.recall)}, "
            f"nearer than {_number(scores.threshold)}"
        )
        name = f"f_score{mark} at {scores.threshold_percent:g} %"
        yield FigureRow(name, _fraction(scores.f_score), meaning)


def _view_rows(view: ViewFigures) -> Iterator[FigureRow]:
    value = f"{_number(view.relative_error)} %"
    yield FigureRow("relative_error", value, "100 ||S - S'|| / ||S - mean S|| where both are hit")
    meaning = f"of {view.pixels} true pixels are covered by the result"
    yield FigureRow("coverage", _fraction(view.coverage), meaning)
    for name, angles, origin in (
        ("shape_normals", view.shape_normals, "of the mesh's shape"),
        ("transferred_normals", view.transferred_normals, "stored with the mesh"),
    ):
        if angles is not None:
            value = f"{_degrees(angles)}; {angles.pitted_percent:.2f} %"
            yield FigureRow(name, value, f"normals {origin}: mean; median; pitted")
    if (albedo := view.albedo) is not None:
        value = f"{albedo.one_scale_percent:.1f} %; {albedo.one_scale_median_percent:.1f} %"
        meaning = "after one scale: root mean square, least squares; median, median ratio"
        yield FigureRow("albedo", value, meaning)
        value = f"{albedo.channel_scales_percent:.1f} %"
        meaning = "after a scale for each channel: root mean square, least squares"
        yield FigureRow("albedo, channel scales", value, meaning)


def _light_rows(lights: LightFigures) -> Iterator[FigureRow]:
    meaning = f"of {lights.lights} lights, in the frame of the truth: mean; median"
    yield FigureRow("direction", _degrees(lights), meaning)
    value = f"{lights.mean_rotated_deg:.2f}°; {lights.median_rotated_deg:.2f}°"
    meaning = f"up to one rotation of all, by {lights.rotation_deg:.2f}°: mean; median"
    yield FigureRow("direction, rotated", value, meaning)


def _camera_rows(cameras: CameraFigures) -> Iterator[FigureRow]:
    value = f"{cameras.missing} of {cameras.views}"
    yield FigureRow("missing", value, "photographs without a camera in the result")
    value = f"{cameras.mean_rotation_deg:.3f}°; {cameras.median_rotation_deg:.3f}°"
    yield FigureRow("rotation", value, "after the similarity on cameras: mean; median")
    percent = cameras.mean_center_percent
    away = "" if math.isnan(percent) else f", {_number(percent)} % of the distance to the object"
    value = f"{_number(cameras.mean_center)}; {_number(cameras.median_center)}"
    meaning = f"after the similarity on cameras, scene units: mean; median{away}"
    yield FigureRow("center", value, meaning)
    value = f"{_number(cameras.mean_focal_percent)} %"
    yield FigureRow("focal", value, "mean absolute error of the focal length")
    if not math.isnan(cameras.mean_position_percent):
        yield FigureRow(
            "positions",
            f"{cameras.mean_position_percent:.4f} %; {cameras.mean_bend_percent:.4f} %",
            "of the diagonal, error of points triangulated from exact pixels: after the similarity "
            "on cameras; after the best one",
        )


def _relit_rows(relighting: Mapping[str, Any]) -> Iterator[FigureRow]:
    views = len(relighting["views"])
    meaning = (
        f"mean over {views} photographs of sRGB values on the object, each under its fitted light"
    )
    for kind in ("", "matte", "textured"):
        value = relighting.get(f"psnr_{kind}_db" if kind else "psnr_db")
        if value is not None:
            yield FigureRow(f"PSNR, {kind}" if kind else "PSNR", f"{value:.2f} dB", meaning)
    for material in relighting["materials"]:
        value = ", ".join(f"{material[key]:.2f}" for key in ("roughness", "specular", "metallic"))
        meaning = f"glTF's material of {material['vertices']:.0%} of the vertices"
        yield FigureRow("roughness, specular, metallic", value, meaning)


def _dtu_rows(dtu: DtuFigures) -> Iterator[FigureRow]:
    value = f"{dtu.mean_accuracy:.4f} mm; {dtu.median_accuracy:.4f} mm"
    part = f"{dtu.evaluated} points in the mask, thinned to {THINNING_MM:g} mm"
    yield FigureRow("accuracy", value, _capped(part, dtu.capped_fraction))
    value = f"{dtu.mean_completeness:.4f} mm; {dtu.median_completeness:.4f} mm"
    part = f"{dtu.evaluated_true} points of the scan above the table"
    yield FigureRow("completeness", value, _capped(part, dtu.capped_fraction_true))
    yield FigureRow("overall", f"{dtu.overall:.4f} mm", "mean of the two means")


def _capped(part: str, fraction: float) -> str:
    return f"{part}: mean; median; {_fraction(fraction)} {CAP_MM:g} mm or more"


def _distance_row(name: str, figures: DistanceFigures, meaning: str) -> FigureRow:
    mean = _with_percent(figures.mean, figures.mean_percent)
    median = _with_percent(figures.median, figures.median_percent)
    return FigureRow(name, f"{mean}; {median}", meaning)


def _with_percent(length: float, percent: float) -> str:
    return f"{_number(length)} ({_number(percent)} %)"


def _degrees(angles: AngleFigures | LightFigures) -> str:
    return f"{angles.mean_deg:.2f}°; {angles.median_deg:.2f}°"


def _number(value: float) -> str:
    return f"{value:.4g}"


def _fraction(value: float) -> str:
    return f"{100 * value:.1f} %"


def plain(value: object) -> object:
    """Return records as mappings, tensors and tuples as lists, non-finite numbers as ``None``."""
    if dataclasses.is_dataclass(value):
        fields = dataclasses.fields(value)
        return {field.name: plain(getattr(value, field.name)) for field in fields}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Tensor):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
