"""The table of the bench: rows of figures, as JSON, as Markdown and on the terminal."""

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table as Grid
from rich.text import Text

from pimper_bench.baselines.missing import MissingProgramError
from pimper_bench.metrics.figure_rows import plain
from pimper_bench.table.measure import Machine
from pimper_torch.records import Record

_COST = "cost"
_RAYS = "along the rays of the reference view"
_COMMON = "where all methods cover the object"
_SURFACE = "distances of surfaces"


class Column(NamedTuple):
    """A figure of the table.

    Attributes:
        part: Part of the table, which is printed separately on the terminal.
    """

    part: str
    heading: str
    decimals: int
    value: Callable[["BenchRow"], float | None]


def _figure(part: str, heading: str, decimals: int, unit: float = 1.0) -> Any:  # noqa: ANN401
    """Return the field of a figure, ``None`` by default, with its column of the table."""
    column = {"part": part, "heading": heading, "decimals": decimals, "unit": unit}
    return dataclasses.field(default=None, metadata=column)


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchRow(Record):
    """One method on one scene; ``None`` for a figure that was not, or cannot be, measured.

    Percentages are of 100, and lengths are percentages of the true bounding box's diagonal;
    :func:`legend` explains the figures.

    Attributes:
        minutes: Wall clock of the method alone.
        sfm_minutes: Wall clock of the structure from motion that all methods share.
        f_scores: Pairs of a threshold, a length, and the F-score there, per cent.
        note: Why figures are missing, such as ``not installed``.
        published: True for figures from a paper, on other photographs.
    """

    scene: str
    method: str
    mesh_points: int | None = _figure(_COST, "points", 0)
    triangles: int | None = _figure(_COST, "triangles", 0)
    samples: int | None = _figure(_COST, "samples, M", 2, unit=1e6)
    missing_percent: float | None = _figure(_COST, "missing, %", 1)
    minutes: float | None = _figure(_COST, "minutes", 1)
    sfm_minutes: float | None = _figure(_COST, "SfM, min", 1)
    peak_memory_mb: float | None = _figure(_COST, "memory, MB", 0)
    relative_error: float | None = _figure(_RAYS, "3D error, %", 2)
    coverage_percent: float | None = _figure(_RAYS, "covered, %", 1)
    mean_normal_deg: float | None = _figure(_RAYS, "normals, °", 2)
    median_normal_deg: float | None = _figure(_RAYS, "median, °", 2)
    mean_shape_normal_deg: float | None = _figure(_RAYS, "shape, °", 2)
    median_shape_normal_deg: float | None = _figure(_RAYS, "shape median, °", 2)
    pitted_percent: float | None = _figure(_RAYS, "pitted, %", 2)
    common_percent: float | None = _figure(_COMMON, "covered by all, %", 1)
    common_relative_error: float | None = _figure(_COMMON, "3D error there, %", 2)
    common_mean_normal_deg: float | None = _figure(_COMMON, "normals there, °", 2)
    common_median_normal_deg: float | None = _figure(_COMMON, "median there, °", 2)
    common_mean_shape_normal_deg: float | None = _figure(_COMMON, "shape there, °", 2)
    common_median_shape_normal_deg: float | None = _figure(_COMMON, "shape median there, °", 2)
    chamfer: float | None = _figure(_SURFACE, "Chamfer, %", 3)
    accuracy: float | None = _figure(_SURFACE, "accuracy, %", 3)
    completeness: float | None = None
    completeness_seen: float | None = _figure(_SURFACE, "complete, %", 3)
    f_scores: tuple[tuple[float, float], ...] = ()
    note: str = ""
    published: bool = False


def row_of_failure(
    scene: str, method: str, error: Exception, **figures: int | float | None
) -> BenchRow:
    """Return the row of a method without a surface; a missing program does not count as failure.

    Args:
        figures: Fields that are known nevertheless, such as ``minutes``.
    """
    kind = "not installed\n" if isinstance(error, MissingProgramError) else "failed: "
    note = f"{kind}{str(error) or type(error).__name__}"
    return BenchRow(scene=scene, method=method, note=note, **figures)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True, kw_only=True)
class Table(Record):
    """All rows, the machine, and settings that affect the figures."""

    rows: tuple[BenchRow, ...]
    machine: Machine
    date: str
    scale: str
    settings: Mapping[str, object] = dataclasses.field(default_factory=dict)


_PRINTED = (
    # scene, method, mesh points, triangles, samples, missing %, minutes, 3D error %
    ("mug", "PiMPeR", 115, 198, 6_690_000, 24.7, 24.4, 7.1),
    ("jar", "PiMPeR", 130, 206, 22_600_000, 57.8, 33.1, 9.34),
    ("balls", "PiMPeR", 250, 362, 42_400_000, 69.5, 62.6, 9.69),
    ("potatoes", "PiMPeR", 150, 276, 36_700_000, 62.7, 50.8, 11.15),
    ("potatoes", "global-stereo", None, None, None, None, 22 * 60.0, 17.34),
)
PUBLISHED = tuple(
    BenchRow(
        scene=scene,
        method=method,
        mesh_points=points,
        triangles=triangles,
        samples=samples,
        missing_percent=missing,
        minutes=minutes,
        relative_error=error,
        published=True,
    )
    for scene, method, points, triangles, samples, missing, minutes, error in _PRINTED
)
"""The figures published for PiMPeR: 30 frames of 1600x1200 each, of real mugs, jars, balls and
potatoes, in Matlab, 2014. Its error is not defined there."""


def with_published(rows: Sequence[BenchRow]) -> tuple[BenchRow, ...]:
    """Group rows by scene, each after the published figures of that scene."""
    scenes = dict.fromkeys(row.scene for row in rows)
    return tuple(row for name in scenes for row in (*PUBLISHED, *rows) if row.scene == name)


def write_json(table: Table, path: Path) -> None:
    """Write a table with all its digits; figures that are not finite become ``null``."""
    report = {"format": "pimper-bench", "version": 1, **dataclasses.asdict(table)}
    text = json.dumps(plain(report), indent=1, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


MISSING = "\N{EN DASH}"
_PUBLISHED_MARK = "†"


def columns(rows: Sequence[BenchRow]) -> dict[str, list[Column]]:
    """Return the columns with at least one figure, by the part of the table."""

    def column(name: str, part: str, heading: str, decimals: int, unit: float) -> Column:
        def value(row: BenchRow) -> float | None:
            figure: float | None = getattr(row, name)
            return figure if figure is None else figure / unit

        return Column(part, heading, decimals, value)

    def f_score(threshold: float) -> Column:
        return Column(
            _SURFACE, f"F {threshold:g} %", 1, lambda row: dict(row.f_scores).get(threshold)
        )

    fields = dataclasses.fields(BenchRow)
    listed = [column(field.name, **field.metadata) for field in fields if field.metadata]
    listed += map(f_score, sorted({threshold for row in rows for threshold, _ in row.f_scores}))
    filled = [column for column in listed if any(_is_known(column.value(row)) for row in rows)]
    parts = (_COST, _RAYS, _COMMON, _SURFACE)
    return {part: [column for column in filled if column.part == part] for part in parts}


def cell(value: int | float | None, decimals: int) -> str:
    """Format a figure with ``decimals`` decimals; a figure above 0 is never rounded to 0.

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
    """Return the table, the meaning of its columns, and the machine, as Markdown."""
    listed = [column for part in columns(table.rows).values() for column in part]
    noted = any(row.note for row in table.rows)
    head = ["scene", "method", *(column.heading for column in listed), *(["note"] * noted)]
    lines = [
        [
            _plain(row.scene),
            _plain(_method(row)),
            *(cell(column.value(row), column.decimals) for column in listed),
            *([_plain(short_note(row))] * noted),
        ]
        for row in table.rows
    ]
    align_right = [False, False, *([True] * len(listed)), *([False] * noted)]
    widths = [max(3, *(len(line[index]) for line in (head, *lines))) for index in range(len(head))]
    layout = list(zip(widths, align_right, strict=True))
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
    """Return a table for each part, then why figures are missing."""
    parts: list[RenderableType] = []
    for title, listed in columns(table.rows).items():
        part_rows = [row for row in table.rows if any(_is_known(c.value(row)) for c in listed)]
        if part_rows:
            parts.append(_grid(f"{title}, scale {table.scale}", listed, part_rows))
    # As Text, a name in brackets is not interpreted as markup.
    parts += [Text(f"{row.scene}, {row.method}: {row.note}") for row in table.rows if row.note]
    return Group(*parts)


def _grid(title: str, listed: Sequence[Column], rows: Sequence[BenchRow]) -> Grid:
    grid = Grid(title=title, box=box.SIMPLE_HEAD, title_justify="left", padding=(0, 1, 0, 0))
    grid.add_column("scene")
    grid.add_column("method")
    for column in listed:
        narrow = "\n".join(column.heading.replace(",", "").split())
        grid.add_column(narrow, justify="right", no_wrap=True)
    for row, following in zip(rows, (*rows[1:], None), strict=True):
        figures = (cell(column.value(row), column.decimals) for column in listed)
        grid.add_row(
            *(Text(word) for word in (row.scene, _method(row), *figures)),
            style="dim" if row.published else None,
            end_section=following is not None and following.scene != row.scene,
        )
    return grid


def legend(table: Table) -> list[str]:
    """Return sentences that explain the columns and the measurement."""
    sentences = [
        "Samples count every template's pixels times the views, including missing ones. Minutes "
        "are of the method alone; structure from motion is shared and listed separately. The 3D "
        "error is `100 ||S - S_hat|| / ||S - mean S||` along the rays of the reference view, over "
        "the fraction of the true pixels that is covered; rays that hit the table through a hole "
        "in the object are misses. There: over the pixels covered by all methods of the scene that "
        "gave a surface. Normals are the stored vertex normals; shape normals are those of the "
        "surface itself. Chamfer (the mean of accuracy and completeness), accuracy, "
        "completeness and the thresholds of F are in % of the diagonal of the true bounding box, "
        "over the part of the true surface that three or more views see. "
        f"{MISSING}: not measured, or not applicable."
    ]
    if any(row.published for row in table.rows):
        sentences.append(
            f"{_PUBLISHED_MARK} As published, on other photographs (real ones, 30 of 1600x1200) "
            "and on a different machine; its error is not defined there."
        )
    settings = ", ".join(f"{name} {_plain(str(value))}" for name, value in table.settings.items())
    measured = f"Scale {table.scale}, {table.date}, on {_plain(table.machine.summary)}"
    sentences.append(f"{measured}{'; ' + settings if settings else ''}.")
    return sentences


def short_note(row: BenchRow) -> str:
    """Return the first line of a note, truncated to a cell; the JSON file has the full note."""
    lines = row.note.strip().splitlines()
    first = lines[0] if lines else ""
    return first if len(first) <= 60 else first[:59].rstrip() + "…"


def _method(row: BenchRow) -> str:
    return f"{row.method} {_PUBLISHED_MARK}" if row.published else row.method


def _is_known(value: int | float | None) -> bool:
    return value is not None and math.isfinite(value)


def _plain(text: str) -> str:
    """Escape a text so that it does not end its cell or row."""
    return " ".join(text.split()).replace("|", "\\|")
