"""The table of the bench: rows of figures, as JSON, Markdown and for the terminal."""

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table as Grid
from rich.text import Text

from pimper_bench.bench.measure import Machine
from pimper_bench.metrics.figure_rows import plain
from pimper_torch.records import Record
from pimper_torch.runtime.errors import MissingProgramError


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchRow(Record):
    """One method on one scene; ``None`` is a figure that was not, or cannot be, measured.

    Percentages are of 100, and lengths are percentages of the true bounding box's diagonal;
    :func:`legend` explains the figures.

    Attributes:
        minutes: Wall clock of this method alone.
        sfm_minutes: Wall clock of the structure from motion that all methods share.
        f_scores: Pairs of a threshold, a length, and the F-score there, per cent.
        note: Why figures are missing, such as ``not installed``.
        published: Printed in a paper, on other photographs.
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


def row_of_failure(
    scene: str, method: str, error: Exception, **known: int | float | None
) -> BenchRow:
    """Return the row of a method that gave no surface; a missing program is no failure.

    Args:
        known: Fields that are known all the same, such as ``minutes``.
    """
    kind = "not installed\n" if isinstance(error, MissingProgramError) else "failed: "
    note = f"{kind}{str(error) or type(error).__name__}"
    return BenchRow(scene=scene, method=method, note=note, **known)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True, kw_only=True)
class Table(Record):
    """All rows, the machine, and settings that decide the figures."""

    rows: tuple[BenchRow, ...]
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
        BenchRow(
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
    BenchRow(
        scene="potatoes",
        method="global-stereo",
        minutes=22 * 60.0,
        relative_error=17.34,
        published=True,
    ),
)
"""The figures printed for PiMPeR: 30 frames of 1600x1200 each, of real mugs, jars, balls and
potatoes, in Matlab, 2014. The error is not defined there."""


def with_published(rows: Sequence[BenchRow]) -> tuple[BenchRow, ...]:
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
        "machine": table.machine,
        "settings": table.settings,
        "rows": table.rows,
    }
    text = json.dumps(plain(report), indent=1, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


MISSING = "\N{EN DASH}"
_PUBLISHED_MARK = "†"


class Column(NamedTuple):
    """A figure of the table."""

    heading: str
    value: Callable[[BenchRow], int | float | None]
    decimals: int


def _columns(*listed: tuple[str, str, int]) -> tuple[Column, ...]:
    """Return columns from their headings, fields of rows and decimals."""
    return tuple(Column(heading, attrgetter(field), digits) for heading, field, digits in listed)


_COST = (
    *_columns(("points", "mesh_points", 0), ("triangles", "triangles", 0)),
    Column("samples, M", lambda row: row.samples and row.samples / 1e6, 2),
    *_columns(
        ("missing, %", "missing_percent", 1),
        ("minutes", "minutes", 1),
        ("SfM, min", "sfm_minutes", 1),
        ("memory, MB", "peak_memory_mb", 0),
    ),
)
_RAYS = _columns(
    ("3D error, %", "relative_error", 2),
    ("covered, %", "coverage_percent", 1),
    ("normals, °", "mean_normal_deg", 2),
    ("median, °", "median_normal_deg", 2),
    ("shape, °", "mean_shape_normal_deg", 2),
    ("shape median, °", "median_shape_normal_deg", 2),
    ("pitted, %", "pitted_percent", 2),
)
_COMMON = _columns(
    ("covered by all, %", "common_percent", 1),
    ("3D error there, %", "common_relative_error", 2),
    ("normals there, °", "common_mean_normal_deg", 2),
    ("median there, °", "common_median_normal_deg", 2),
    ("shape there, °", "common_mean_shape_normal_deg", 2),
    ("shape median there, °", "common_median_shape_normal_deg", 2),
)
_SURFACE = _columns(
    ("Chamfer, %", "chamfer", 3),
    ("accuracy, %", "accuracy", 3),
    ("complete, %", "completeness_seen", 3),
)


def columns(rows: Sequence[BenchRow]) -> dict[str, tuple[Column, ...]]:
    """Return the columns that some row has a figure for, by what they are about."""

    def known(columns: Sequence[Column]) -> tuple[Column, ...]:
        return tuple(
            column for column in columns if any(_is_known(column.value(row)) for row in rows)
        )

    thresholds = sorted({threshold for row in rows for threshold, _ in row.f_scores})
    scores = tuple(
        Column(
            f"F {threshold:g} %",
            lambda row, threshold=threshold: dict(row.f_scores).get(threshold),  # type: ignore[misc]
            1,
        )
        for threshold in thresholds
    )
    return {
        "cost": known(_COST),
        "along the rays of the reference view": known(_RAYS),
        "where all methods cover the object": known(_COMMON),
        "distances of surfaces": known((*_SURFACE, *scores)),
    }


def cell(value: int | float | None, decimals: int) -> str:
    """Format a figure with so many decimals; a figure above 0 is never rounded to 0.

    >>> cell(1234.5, 1), cell(0.004, 2), cell(0.0, 2), cell(None, 2)
    ('1,234.5', '<0.01', '0.00', '–')
    """
    if value is None or not math.isfinite(value):
        return MISSING
    least = 10.0**-decimals
    if 0 < value < least / 2:
        return f"<{least:.{decimals}f}"
    return f"{value:,.{decimals}f}"


def markdown(table: Table) -> str:
    """Write the table, what its columns mean, and what it was measured on."""
    shown = [column for part in columns(table.rows).values() for column in part]
    noted = any(row.note for row in table.rows)
    head = ["scene", "method", *(column.heading for column in shown), *(["note"] * noted)]
    lines = [
        [
            _plain(row.scene),
            _plain(_method(row)),
            *(cell(column.value(row), column.decimals) for column in shown),
            *([_plain(short_note(row))] * noted),
        ]
        for row in table.rows
    ]
    right = [False, False, *([True] * len(shown)), *([False] * noted)]
    widths = [max(3, *(len(line[index]) for line in (head, *lines))) for index in range(len(head))]
    layout = list(zip(widths, right, strict=True))
    rule = ["-" * (width - to_right) + ":" * to_right for width, to_right in layout]
    parts = ["\n".join(_line(line, layout) for line in (head, rule, *lines)), *legend(table)]
    return "\n\n".join(parts) + "\n"


def _line(words: Sequence[str], layout: Sequence[tuple[int, bool]]) -> str:
    padded = [
        word.rjust(width) if to_right else word.ljust(width)
        for word, (width, to_right) in zip(words, layout, strict=True)
    ]
    return f"| {' | '.join(padded)} |"


def terminal(table: Table) -> Group:
    """Return a table for each kind of figures, then why figures are missing."""
    parts: list[RenderableType] = []
    for title, shown in columns(table.rows).items():
        shown_rows = [row for row in table.rows if any(_is_known(one.value(row)) for one in shown)]
        if shown_rows:
            parts.append(_grid(f"{title}, scale {table.scale}", shown, shown_rows))
    # Text, for a name in brackets is no markup.
    parts += [Text(f"{row.scene}, {row.method}: {row.note}") for row in table.rows if row.note]
    return Group(*parts)


def _grid(title: str, shown: Sequence[Column], rows: Sequence[BenchRow]) -> Grid:
    grid = Grid(title=title, box=box.SIMPLE_HEAD, title_justify="left", padding=(0, 1, 0, 0))
    grid.add_column("scene")
    grid.add_column("method")
    for column in shown:
        narrow = "\n".join(column.heading.replace(",", "").split())
        grid.add_column(narrow, justify="right", no_wrap=True)
    for row, following in zip(rows, (*rows[1:], None), strict=True):
        figures = (cell(column.value(row), column.decimals) for column in shown)
        grid.add_row(
            *(Text(word) for word in (row.scene, _method(row), *figures)),
            style="dim" if row.published else None,
            end_section=following is not None and following.scene != row.scene,
        )
    return grid


def legend(table: Table) -> list[str]:
    """Explain the columns and the measurement in sentences."""
    sentences = [
        "Samples count every template's pixels times the views, missing ones included. Minutes "
        "are of the method alone; structure from motion is shared and stands apart. The 3D error "
        "is `100 ||S - S_hat|| / ||S - mean S||` along the rays of the reference view, over the "
        "fraction of the true pixels that is covered; rays that meet a surface on the table, by "
        "a hole in the object, are misses. There: over the pixels that all methods of the scene "
        "cover that gave a surface. Normals are those that the vertices carry; "
        "shape is the surface's own. Chamfer (the mean of accuracy and completeness), accuracy, "
        "completeness and the thresholds of F are in % of the diagonal of the true bounding box, "
        "over the part of the true surface that three views or more see. "
        f"{MISSING}: not measured, or not applicable."
    ]
    if any(row.published for row in table.rows):
        sentences.append(
            f"{_PUBLISHED_MARK} As published, on other photographs (real ones, 30 of 1600x1200) "
            "and another machine; its error is not defined there."
        )
    settings = ", ".join(f"{name} {_plain(str(value))}" for name, value in table.settings.items())
    measured = f"Scale {table.scale}, {table.date}, on {_plain(table.machine.summary)}"
    sentences.append(f"{measured}{'; ' + settings if settings else ''}.")
    return sentences


def short_note(row: BenchRow) -> str:
    """Return the first line of a note, cut to a cell's width; the JSON file has the whole."""
    lines = row.note.strip().splitlines()
    first = lines[0] if lines else ""
    return first if len(first) <= 60 else first[:59].rstrip() + "…"


def _method(row: BenchRow) -> str:
    return f"{row.method} {_PUBLISHED_MARK}" if row.published else row.method


def _is_known(value: int | float | None) -> bool:
    return value is not None and math.isfinite(value)


def _plain(text: str) -> str:
    """Keep a text from ending its cell or its row."""
    return " ".join(text.split()).replace("|", "\\|")
