"""What a study measures, and the tables of documents that show it.

A study has rows, each a function that returns figures. A table shows some of them in a document.
:data:`Figures` are kept as JSON, so they are numbers, texts, and lists and mappings of these.
"""

import hashlib
import json
import os
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pimper_bench.scenes import SceneConfig, render_scene

Figures = dict[str, Any]
Key = tuple[str, ...]
Kept = Mapping[Key, Figures]
Lines = Callable[[Kept], list[list[str]]]

# Data that may not be published with the package; by default next to the repository.
DATA = Path(os.environ.get("PIMPER_DATA", Path(__file__).parents[3] / "shared" / "data"))
TINY = {"num_views": 8, "width": 240, "height": 180}  # of scenes, for tests
MISSING = "\N{EN DASH}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Where rows find photographs and keep files.

    Attributes:
        cache: Folder for everything that is kept between rows.
        tiny: Whether scenes have eight small photographs, for tests.
        used: Digests of the photographs that a row used so far.
    """

    cache: Path
    tiny: bool = False
    used: list[str] = field(default_factory=list)

    def scene(self, name: str, **settings: Any) -> Path:  # noqa: ANN401 - of SceneConfig
        """Return the folder of a scene, rendered unless it exists."""
        if self.tiny:
            settings |= TINY
        told = json.dumps([Path(name).name, settings], sort_keys=True)
        folder = self.cache / "scenes" / f"{Path(name).stem}-{zlib.crc32(told.encode()):08x}"
        if not folder.exists():
            render_scene(name, folder, SceneConfig(**settings))
        return self.photographs(folder, "photos")

    def photographs(self, folder: Path, inside: str = ".") -> Path:
        """Return a folder, and remember the digest of the photographs inside."""
        content = hashlib.sha256()
        for path in sorted((folder / inside).rglob("*.*")):
            content.update(path.read_bytes())
        self.used.append(content.hexdigest()[:12])
        return folder


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What a row of figures is measured by.

    Attributes:
        inputs: Of a rival alone, which is measured again only if the photographs change: what it
            is measured on.
    """

    measure: Callable[[Place], Figures]
    inputs: Callable[[Place], object] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table of a document.

    Attributes:
        name: Of the markers in the document.
        document: Path in the repository.
        lines: The head and the rows, as texts of cells.
        labels: Number of columns that are aligned to the left.
        part: Only rows whose key begins with this, without it.
    """

    name: str
    document: str
    lines: Lines
    labels: int = 1
    part: str | None = None

    def shown(self, rows: Mapping[Key, Figures]) -> dict[Key, Figures]:
        """Return the rows of this table."""
        if self.part is None:
            return dict(rows)
        return {key[1:]: row for key, row in rows.items() if key[0] == self.part}


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """A question: its rows and its tables.

    Attributes:
        draw: Draws the file ``picture`` of the repository from what rows kept.
    """

    name: str
    rows: Mapping[Key, Row]
    tables: Sequence[Table]
    draw: Callable[[Place, Path], None] | None = None
    picture: str = ""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of :func:`listed`: its heading, and the text of a row's cell."""

    heading: str
    text: Callable[[Figures], str]


def number(value: float | None, decimals: int = 2) -> str:
    """Format a figure; one above 0 is never rounded to 0.

    >>> number(1234.5, 1), number(0.004), number(None)
    ('1,234.5', '<0.01', '–')
    """
    if value is None or value != value:
        return MISSING
    least = 10.0**-decimals
    return f"<{least:.{decimals}f}" if 0 < value < least / 2 else f"{value:,.{decimals}f}"


def figure(heading: str, name: str, decimals: int = 2) -> Column:
    """Return a column of one figure."""
    return Column(heading, lambda row: number(row.get(name), decimals))


def bracketed(heading: str, name: str, other: str, decimals: int = 2) -> Column:
    """Return a column of a figure with another one in brackets."""
    both = "{} ({})".format
    return Column(
        heading, lambda row: both(*(number(row.get(each), decimals) for each in (name, other)))
    )


def said(heading: str, name: str) -> Column:
    """Return a column of a text."""
    return Column(heading, lambda row: str(row.get(name, MISSING)))


def listed(labels: Sequence[str], columns: Iterable[Column]) -> Lines:
    """Return lines with the parts of each key, then columns of figures."""
    shown = [*columns]
    head = [*labels, *(column.heading for column in shown)]
    return lambda kept: [
        head,
        *([*key, *(column.text(row) for column in shown)] for key, row in kept.items()),
    ]
