"""An evaluation as rows for the terminal and as plain mappings for JSON."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from pimper_torch.evidence.metrics.camera_errors import CameraFigures, LightFigures
from pimper_torch.evidence.metrics.dtu_protocol import CAP_MM, THINNING_MM, DtuFigures
from pimper_torch.evidence.metrics.evaluation import Evaluation
from pimper_torch.evidence.metrics.in_view import ViewFigures
from pimper_torch.evidence.metrics.surface_distances import (
    Calibration,
    DistanceFigures,
    SurfaceComparison,
    TwoSided,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A figure as a person reads it.

    Attributes:
        name: Of the convention, as in the JSON.
        meaning: What it says, and over what.
    """

    name: str
    value: str
    meaning: str


def report(evaluation: Evaluation) -> dict[str, object]:
    """Return all figures as plain mappings, lists and numbers; what is not finite is ``None``.

    Names are those of the records; those that end in ``_percent``, ``_deg`` are in these
    units, the other lengths in scene units of the truth, and those of ``dtu`` in millimetres.
    """
    plain = _plain(evaluation)
    assert isinstance(plain, dict)
    return plain


def rows(
    evaluation: Evaluation, relighting: Mapping[str, Any] | None = None
) -> list[tuple[str, list[Row]]]:
    """Return the figures as a table: its sections with their rows, none of them empty.

    Args:
        relighting: What ``summary.json`` of the result tells under this name.
    """
    sections: list[tuple[str, Iterator[Row]]] = [("alignment", _alignment_rows(evaluation))]
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
    return [(title, found) for title, lines in sections if (found := list(lines))]


def _alignment_rows(evaluation: Evaluation) -> Iterator[Row]:
    alignment = evaluation.alignment
    yield Row(name="method", value=alignment.method, meaning=alignment.description)
    yield Row(
        name="scale, rotation",
        value=f"{_number(alignment.scale)}, {alignment.rotation_deg:.2f}°",
        meaning="of the similarity that carries the result to the truth",
    )
    if alignment.residual is not None:
        state = "came to rest" if alignment.converged else "stopped by the limit of iterations"
        yield Row(
            name="residual",
            value=_number(alignment.residual),
            meaning=f"root mean square of the samples kept, scene units; {state}",
        )


def _surface_rows(surface: SurfaceComparison) -> Iterator[Row]:
    yield Row(
        name="diagonal",
        value=_number(surface.diagonal),
        meaning="of the true object's bounding box, scene units; % below are of it",
    )
    if surface.accuracy is not None:
        yield _distance_row("accuracy", surface.accuracy, "result to truth: mean; median")
    if surface.surroundings_fraction > 0:
        yield Row(
            name="surroundings_fraction",
            value=_fraction(surface.surroundings_fraction),
            meaning="of the result lies nearer to the surroundings; left out of the accuracy",
        )
    if surface.whole is not None:
        yield from _two_sided_rows(surface.whole, "", "the whole truth")
    if surface.seen is not None and surface.seen_fraction is not None:
        part = (
            f"the {_fraction(surface.seen_fraction)} of it seen from {surface.seen_from} positions"
        )
        yield from _two_sided_rows(surface.seen, " (seen)", part)
    if surface.calibration is not None:
        yield from _calibration_rows(surface.calibration, surface.diagonal)


def _calibration_rows(found: Calibration, diagonal: float) -> Iterator[Row]:
    yield Row(
        name="expected_error",
        value=f"{found.ratio:.2f}; {_fraction(found.within_one)}, {_fraction(found.within_two)}; "
        f"{found.rank_correlation:.2f}",
        meaning="true over expected error, 1 if calibrated; true error within one and two "
        "expected, 68 and 95 % if calibrated; rank correlation",
    )
    for which, one in (("surest", found.bins[0]), ("least sure", found.bins[-1])):
        yield Row(
            name=f"{which} tenth",
            value=f"{_number(100 * one.expected / diagonal)} %; "
            f"{_number(100 * one.root_mean_square / diagonal)} %",
            meaning="expected error; true error, root mean squares",
        )


def _two_sided_rows(figures: TwoSided, mark: str, part: str) -> Iterator[Row]:
    yield _distance_row(
        f"completeness{mark}", figures.completeness, f"truth to result, over {part}: mean; median"
    )
    for name, length, percent, meaning in (
        ("chamfer_mean", figures.chamfer_mean, figures.chamfer_mean_percent, "mean"),
        ("chamfer_sum", figures.chamfer_sum, figures.chamfer_sum_percent, "sum"),
    ):
        yield Row(
            name=name + mark,
            value=f"{_number(length)} ({_number(percent)} %)",
            meaning=f"{meaning} of mean accuracy and mean completeness{mark}",
        )
    for at in figures.thresholds:
        yield Row(
            name=f"f_score{mark} at {at.threshold_percent:g} %",
            value=_fraction(at.f_score),
            meaning=f"precision {_fraction(at.precision)}, recall{mark} {_fraction(at.recall)}, "
            f"nearer than {_number(at.threshold)}",
        )


def _view_rows(view: ViewFigures) -> Iterator[Row]:
    yield Row(
        name="relative_error",
        value=f"{_number(view.relative_error)} %",
        meaning="100 ||S - S'|| / ||S - mean S|| where both are met",
    )
    yield Row(
        name="coverage",
        value=_fraction(view.coverage),
        meaning=f"of {view.pixels} true pixels are met by the result",
    )
    for name, angles, meaning in (
        ("shape_normals", view.shape_normals, "normals of the mesh's shape: mean; median; pitted"),
        (
            "transferred_normals",
            view.transferred_normals,
            "normals the mesh carries: mean; median; pitted",
        ),
    ):
        if angles is not None:
            value = (
                f"{angles.mean_deg:.2f}°; {angles.median_deg:.2f}°; {angles.pitted_percent:.2f} %"
            )
            yield Row(name=name, value=value, meaning=meaning)
    if view.albedo is not None:
        yield Row(
            name="albedo",
            value=f"{view.albedo.one_scale_percent:.1f} %; "
            f"{view.albedo.one_scale_median_percent:.1f} %",
            meaning="after one scale: root mean square, least squares; median, median ratio",
        )
        yield Row(
            name="albedo, channel scales",
            value=f"{view.albedo.channel_scales_percent:.1f} %",
            meaning="after a scale for each channel: root mean square, least squares",
        )


def _light_rows(lights: LightFigures) -> Iterator[Row]:
    yield Row(
        name="direction",
        value=f"{lights.mean_deg:.2f}°; {lights.median_deg:.2f}°",
        meaning=f"of {lights.lights} lights, in the frame of the truth: mean; median",
    )
    yield Row(
        name="direction, rotated",
        value=f"{lights.mean_rotated_deg:.2f}°; {lights.median_rotated_deg:.2f}°",
        meaning=f"up to one rotation of all, by {lights.rotation_deg:.2f}°: mean; median",
    )


def _camera_rows(cameras: CameraFigures) -> Iterator[Row]:
    yield Row(
        name="missing",
        value=f"{cameras.missing} of {cameras.views}",
        meaning="photographs without a camera in the result",
    )
    yield Row(
        name="rotation",
        value=f"{cameras.mean_rotation_deg:.3f}°; {cameras.median_rotation_deg:.3f}°",
        meaning="after the similarity on cameras: mean; median",
    )
    percent = cameras.mean_center_percent
    away = "" if math.isnan(percent) else f", {_number(percent)} % of the way to the object"
    yield Row(
        name="center",
        value=f"{_number(cameras.mean_center)}; {_number(cameras.median_center)}",
        meaning=f"after the similarity on cameras, scene units: mean; median{away}",
    )
    yield Row(
        name="focal",
        value=f"{_number(cameras.mean_focal_percent)} %",
        meaning="mean of the absolute differences of the focal length",
    )
    if not math.isnan(cameras.mean_position_percent):
        yield Row(
            name="positions",
            value=f"{cameras.mean_position_percent:.4f} %; {cameras.mean_bend_percent:.4f} %",
            meaning="of the diagonal, that exact rays put points off: after the similarity on "
            "cameras; after the best one",
        )


def _relit_rows(relighting: Mapping[str, Any]) -> Iterator[Row]:
    meaning = "mean over {} photographs of sRGB values on the object, each under its fitted light"
    meaning = meaning.format(len(relighting["views"]))
    names = {
        "psnr_db": "PSNR",
        "psnr_matte_db": "PSNR, matte",
        "psnr_textured_db": "PSNR, textured",
    }
    for key, name in names.items():
        if (value := relighting.get(key)) is not None:
            yield Row(name=name, value=f"{value:.2f} dB", meaning=meaning)
    for one in relighting["materials"]:
        yield Row(
            name="roughness, specular, metallic",
            value=f"{one['roughness']:.2f}, {one['specular']:.2f}, {one['metallic']:.2f}",
            meaning=f"glTF's material of {one['vertices']:.0%} of the vertices",
        )


def _dtu_rows(dtu: DtuFigures) -> Iterator[Row]:
    cap = f"{CAP_MM:g} mm or more"
    yield Row(
        name="accuracy",
        value=f"{dtu.mean_accuracy:.4f} mm; {dtu.median_accuracy:.4f} mm",
        meaning=f"{dtu.evaluated} points in the mask, thinned to {THINNING_MM:g} mm: mean; median; "
        f"{_fraction(dtu.capped_fraction)} {cap}",
    )
    yield Row(
        name="completeness",
        value=f"{dtu.mean_completeness:.4f} mm; {dtu.median_completeness:.4f} mm",
        meaning=f"{dtu.evaluated_true} points of the scan above the table: mean; median; "
        f"{_fraction(dtu.capped_fraction_true)} {cap}",
    )
    yield Row(name="overall", value=f"{dtu.overall:.4f} mm", meaning="mean of the two means")


def _distance_row(name: str, figures: DistanceFigures, meaning: str) -> Row:
    value = (
        f"{_number(figures.mean)} ({_number(figures.mean_percent)} %); "
        f"{_number(figures.median)} ({_number(figures.median_percent)} %)"
    )
    return Row(name=name, value=value, meaning=meaning)


def _number(value: float) -> str:
    return f"{value:.4g}"


def _fraction(value: float) -> str:
    return f"{100 * value:.1f} %"


def _plain(value: object) -> object:
    if dataclasses.is_dataclass(value):
        fields = dataclasses.fields(value)
        return {field.name: _plain(getattr(value, field.name)) for field in fields}
    if isinstance(value, Tensor):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
