"""The table of a batch: as CSV, as a page with pictures, and in a terminal."""

import csv
import html
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

from pimper_torch.cli.batches.objects import CSV, HTML
from pimper_torch.cli.batches.task import Outcome
from pimper_torch.doors.outputs.files import file_written_whole

_COLUMNS = (
    *("name", "status", "tries", "seconds", "views", "registered", "vertices", "faces"),
    *("peak_memory_mb", "place", "message", "photographs"),
)
SIGNS = {CSV: "name,status,tries,seconds", HTML: "<!-- pimper batch -->"}
"""Text that tells our files: only what holds it is replaced."""

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ font: 15px system-ui, sans-serif; margin: 2em }}
td, th {{ padding: .3em .8em; text-align: left; vertical-align: top }}
img {{ width: 240px }} .failed, .lost {{ color: #b00 }}
</style></head><body><h1>{title}</h1>{sign}<table>
{rows}
</table></body></html>
"""


def rows_of(
    outcomes: Sequence[Outcome], out: Path, photos: Mapping[str, Path | str]
) -> list[dict[str, object]]:
    """Return a row an object, by its columns: how it ended, and figures of its result."""
    rows = []
    for one in outcomes:
        row: dict[str, object] = {}
        if one.status in ("ended", "kept"):
            summary = json.loads((out / one.name / "summary.json").read_text(encoding="utf-8"))
            row = {name: summary.get(name, "") for name in _COLUMNS}
        row |= {"name": one.name, "status": one.status, "tries": one.tries, "place": one.place}
        row |= {"message": one.message, "photographs": str(photos[one.name])}
        row["seconds"] = round(one.seconds or float(str(row.get("seconds") or 0)), 1)
        rows.append(row)
    return rows


def terminal(out: Path) -> str:
    """Read a batch's table, and return it without messages and paths, in columns."""
    with (out / CSV).open(encoding="utf-8", newline="") as file:
        rows = [*csv.DictReader(file)]
    names = ("name", "status", "tries", "seconds", "registered", "faces")
    cells = [names, *([row[name] for name in names] for row in rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(names))]
    lines = (
        "  ".join(
            cell.ljust(width) if column < 2 else cell.rjust(width)  # numbers to the right
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in cells
    )
    return "\n".join(lines)


def write_table(rows: Sequence[Mapping[str, object]], out: Path) -> None:
    """Write ``batch.csv`` and ``batch.html``, with pictures that link to the objects' reports."""
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, _COLUMNS, restval="")
    table.writeheader()
    table.writerows(rows)
    ended = sum(row["status"] in ("ended", "kept") for row in rows)
    head = "".join(f"<th>{name.replace('_', ' ')}</th>" for name in ("", *_COLUMNS))
    body = "\n".join(f"<tr>{_picture(row, out)}{_cells(row)}</tr>" for row in rows)
    page = _PAGE.format(
        title=f"{ended} of {len(rows)} objects", sign=SIGNS[HTML], rows=f"<tr>{head}</tr>\n{body}"
    )
    for name, content in ((CSV, text.getvalue()), (HTML, page)):
        with file_written_whole(out / name) as fresh:
            fresh.write_text(content, encoding="utf-8", newline="")


def _picture(row: Mapping[str, object], out: Path) -> str:
    name = str(row["name"])
    picture, report = (out / name / file for file in ("overview.png", "report.html"))
    if not picture.exists():
        return "<td></td>"
    target, source = (
        PurePosixPath("/", name, path.name).as_uri().removeprefix("file:///")
        for path in (report if report.exists() else picture, picture)
    )
    return f'<td><a href="{target}"><img loading="lazy" src="{source}" alt=""></a></td>'


def _cells(row: Mapping[str, object]) -> str:
    status = html.escape(str(row["status"]))
    cells = (html.escape(str(row.get(name, ""))) for name in _COLUMNS)
    return "".join(f'<td class="{status}">{cell}</td>' for cell in cells)
