"""The table of a batch, as CSV and as a page with pictures."""

import csv
import html
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
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


def write_table(outcomes: Sequence[Outcome], out: Path, photos: Mapping[str, Path | str]) -> None:
    """Write ``batch.csv`` and ``batch.html``, with pictures that link to the objects' reports."""
    rows = [_row(one, out) | {"photographs": str(photos[one.name])} for one in outcomes]
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, _COLUMNS, restval="")
    table.writeheader()
    table.writerows(rows)
    ended = sum(one.status in ("ended", "kept") for one in outcomes)
    head = "".join(f"<th>{name.replace('_', ' ')}</th>" for name in ("", *_COLUMNS))
    lines = [f"<tr>{head}</tr>", *(f"<tr>{_cells(row, out)}</tr>" for row in rows)]
    title = f"{ended} of {len(rows)} objects"
    page = _PAGE.format(title=title, sign=SIGNS[HTML], rows="\n".join(lines))
    for name, content in ((CSV, text.getvalue()), (HTML, page)):
        with file_written_whole(out / name) as fresh:
            fresh.write_text(content, encoding="utf-8", newline="")


def _row(one: Outcome, out: Path) -> dict[str, object]:
    """Return how an object ended and figures of its result, by column."""
    row: dict[str, object] = {}
    if one.status in ("ended", "kept"):
        summary = json.loads((out / one.name / "summary.json").read_text(encoding="utf-8"))
        row = {name: summary.get(name, "") for name in _COLUMNS}
    seconds = round(one.seconds or float(str(row.get("seconds") or 0)), 1)
    return row | asdict(one) | {"seconds": seconds}


def _cells(row: Mapping[str, object], out: Path) -> str:
    folder = out / str(row["name"])
    link = PurePosixPath("/", folder.name).as_uri().removeprefix("file:///")
    target = "report.html" if (folder / "report.html").exists() else "overview.png"
    shown = f'<a href="{link}/{target}"><img loading="lazy" src="{link}/overview.png" alt=""></a>'
    picture = shown if (folder / "overview.png").exists() else ""
    status = html.escape(str(row["status"]))
    cells = (html.escape(str(row.get(column, ""))) for column in _COLUMNS)
    return f"<td>{picture}</td>" + "".join(f'<td class="{status}">{cell}</td>' for cell in cells)
