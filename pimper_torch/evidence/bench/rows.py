"""Rows of the table: cost and errors of every method; the machine; JSON files."""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pimper_torch.config import to_mapping
from pimper_torch.errors import MissingProgramError, OutputError
from pimper_torch.evidence.bench.machine import Machine
from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True)
class Row(Record):
    """One method on one scene; ``None`` is what was not, or cannot be, measured.

    Percentages are of 100. Lengths are percentages of the true bounding box's diagonal.

    Attributes:
        mesh_points: Vertices of the coarse mesh.
        samples: Samples of all templates times views, missing ones included.
        minutes: Wall clock of this method alone.
        sfm_minutes: Wall clock of the structure from motion that all methods share.
        relative_error: The published 3D error, along the rays of the reference view, per cent.
        coverage_percent: Of the true pixels, those whose ray meets the surface, and not where
            it shows the table; the 3D error is over these.
        mean_normal_deg: Error of the normals that the vertices carry.
        mean_shape_normal_deg: Error of the normals of the surface's own shape.
        common_percent: Of the true pixels, those that all methods of the table cover that gave
            a surface.
        common_relative_error: The 3D error over these.
        common_mean_normal_deg: Of the normals that the vertices carry, over these.
        common_mean_shape_normal_deg: Of the surface's own shape, over these.
        pitted_percent: Rays where these are far further off than around: pimples and pits.
        chamfer: Mean of accuracy and completeness of what three views or more see.
        accuracy: Mean distance from the surface to the truth.
        completeness: Mean distance from the truth to the surface.
        completeness_seen: The same from the truth that three views or more see.
        f_scores: Pairs of a threshold, a length, and the F-score there, per cent, over the
            truth that three views or more see.
        peak_memory_mb: Highest resident memory while the method ran.
        note: Why figures are missing, such as ``not installed``.
        published: Printed in a paper, on photographs that are not these.
    """

    scene: str
    method: str
    mesh_points: int | None = None
    triangles: int | None = None
    samples: int | None = None
    missing_percent: float | None = None
    minutes: float | None = None
    sfm_minutes: float | None = None
    relative_error: float | None = None
    coverage_percent: float | None = None
    mean_normal_deg: float | None = None
    median_normal_deg: float | None = None
    mean_shape_normal_deg: float | None = None
    median_shape_normal_deg: float | None = None
    common_percent: float | None = None
    common_relative_error: float | None = None
    common_mean_normal_deg: float | None = None
    common_median_normal_deg: float | None = None
    common_mean_shape_normal_deg: float | None = None
    common_median_shape_normal_deg: float | None = None
    pitted_percent: float | None = None
    chamfer: float | None = None
    accuracy: float | None = None
    completeness: float | None = None
    completeness_seen: float | None = None
    f_scores: tuple[tuple[float, float], ...] = ()
    peak_memory_mb: float | None = None
    note: str = ""
    published: bool = False


def row_of_failure(scene: str, method: str, error: Exception, **known: int | float | None) -> Row:
    """Make the row of a method that gave no surface.

    Args:
        error: What stopped it; a missing program is no failure.
        known: Fields that are known all the same, such as ``minutes``.
    """
    message = str(error) or type(error).__name__
    # The table shows the first line only.
    note = (
        f"not installed\n{message}"
        if isinstance(error, MissingProgramError)
        else f"failed: {message}"
    )
    return Row(scene=scene, method=method, note=note, **known)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True, kw_only=True)
class Table(Record):
    """All rows, and where and how they were measured.

    Attributes:
        rows: In the order they are shown.
        date: ISO 8601.
        scale: ``quick`` or ``full``.
        settings: Whatever else decides the figures, as JSON can hold it.
    """

    rows: tuple[Row, ...]
    machine: Machine
    date: str
    scale: str
    settings: Mapping[str, object] = dataclasses.field(default_factory=dict)


_PRINTED = (
    # scene, mesh points, triangles, samples, missing %, minutes, 3D error %
    ("mug", 115, 198, 6_690_000, 24.7, 24.4, 7.1),
    ("jar", 130, 206, 22_600_000, 57.8, 33.1, 9.34),
    ("balls", 250, 362, 42_400_000, 69.5, 62.6, 9.69),
    ("potatoes", 150, 276, 36_700_000, 62.7, 50.8, 11.15),
)
PUBLISHED = (
    *(
        Row(
            scene=scene,
            method="PiMPeR",
            mesh_points=points,
            triangles=triangles,
            samples=samples,
            missing_percent=missing,
            minutes=minutes,
            relative_error=error,
            published=True,
        )
        for scene, points, triangles, samples, missing, minutes, error in _PRINTED
    ),
    Row(
        scene="potatoes",
        method="global-stereo",
        minutes=22 * 60.0,
        relative_error=17.34,
        published=True,
    ),
)
"""The figures printed for PiMPeR: 30 frames of 1600x1200 each, of real mugs, jars, balls and
potatoes, in Matlab, 2014. The error is not defined there."""


def with_published(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Group rows by scene, each after the published figures for that scene."""
    scenes = dict.fromkeys(row.scene for row in rows)
    return tuple(row for name in scenes for row in (*PUBLISHED, *rows) if row.scene == name)


def write_json(table: Table, path: Path) -> None:
    """Write a table with all its digits; figures that are not finite become ``null``."""
    report = {
        "format": "pimper-bench",
        "version": 1,
        "date": table.date,
        "scale": table.scale,
        "machine": to_mapping(table.machine),
        "settings": dict(table.settings),
        "rows": [to_mapping(row) for row in table.rows],
    }
    text = json.dumps(_finite(report), indent=1, ensure_ascii=False, allow_nan=False)
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror}). Write elsewhere."
        ) from error


def _finite(value: object) -> object:
    """Replace figures that are not finite by null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
