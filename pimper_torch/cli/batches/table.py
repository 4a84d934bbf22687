"""The table of a batch, as CSV and as a page with pictures."""

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from html import escape
from importlib import resources
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
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
{sign}
<style>
{style}
a {{ color: inherit; }}
code {{ white-space: nowrap; }}
td img {{
  display: block; width: 240px; aspect-ratio: 16 / 10; object-fit: cover; object-position: top;
  border-radius: 4px;
}}
td.name {{ font-weight: 600; white-space: normal; overflow-wrap: anywhere; }}
.failed, .lost, .waiting {{ color: var(--bad); }}
@media (max-width: 900px) {{
  #sections tr {{ display: block; padding: 10px 0; }}
  #sections tr:nth-child(n + 3) {{ border-top: 1px solid var(--line); }}
  #sections tr:first-child, #objects td:empty {{ display: none; }}
  td.text {{ display: block; }}
  #objects td {{ display: inline-block; }}
  #objects td[title]::before {{ content: attr(title) " "; color: var(--faint); }}
  #objects td:first-child, td img {{ display: block; width: 100%; padding: 0; }}
}}
</style>
</head>
<body>
<header><h1>{title}</h1><p>{counts}</p></header>
<div id="sections">
<section id="objects"><div class="scroll"><table>
<tr><th></th><th>object</th><th>status</th><th class="number">photographs</th>
<th class="number">vertices</th><th class="number">faces</th><th class="number">time</th>
<th class="number">memory</th></tr>
{rows}
</table></div></section>
<section{hidden}><h2>Without a result</h2><div class="scroll"><table>
<tr><th>reason</th><th>objects</th></tr>
{reasons}
</table></div></section>
</div>
</body>
</html>
"""


def write_table(outcomes: Sequence[Outcome], out: Path, photos: Mapping[str, Path | str]) -> None:
    """Write ``batch.csv`` and ``batch.html``, with pictures that link to the objects' reports."""
    rows = [_row(one, out) | {"photographs": str(photos[one.name])} for one in outcomes]
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, _COLUMNS, restval="")
    table.writeheader()
    table.writerows(rows)
    for name, content in ((CSV, text.getvalue()), (HTML, _page(rows, out))):
        with file_written_whole(out / name) as fresh:
            fresh.write_text(content, encoding="utf-8", newline="")


def _row(one: Outcome, out: Path) -> dict[str, object]:
    """Return how an object ended and figures of its result, by column."""
    row: dict[str, object] = {}
    if _has_result(asdict(one)):
        summary = json.loads((out / one.name / "summary.json").read_text(encoding="utf-8"))
        row = {name: summary.get(name, "") for name in _COLUMNS}
    seconds = one.seconds or float(str(row.get("seconds") or 0))
    row |= asdict(one) | {"seconds": seconds}
    return {key: round(it, 1) if isinstance(it, float) else it for key, it in row.items()}


def _has_result(row: Mapping[str, object]) -> bool:
    return row["status"] in ("ended", "kept")


def _page(rows: Sequence[Mapping[str, object]], out: Path) -> str:
    style = resources.files("pimper_torch") / "result" / "report" / "page.css"
    statuses = [str(row["status"]) for row in rows]
    reasons = _reasons(rows, out)
    return _PAGE.format(
        title=f"{sum(map(_has_result, rows))} of {len(rows)} objects",
        counts=", ".join(f"{statuses.count(one)} {one}" for one in dict.fromkeys(statuses)),
        style=style.read_text(encoding="utf-8"),
        sign=SIGNS[HTML],
        rows="\n".join(_line(row, out) for row in rows),
        hidden="" if reasons else " hidden",
        reasons="\n".join(
            f'<tr><td class="text">{_marked_up(reason)}</td>'
            f'<td class="text">{escape(", ".join(names))}</td></tr>'
            for reason, names in reasons.items()
        ),
    )


def _marked_up(text: str) -> str:
    return re.sub("`([^`]+)`", r"<code>\1</code>", escape(text))


def _line(row: Mapping[str, object], out: Path) -> str:
    """Return an object's row of the page; without a result, its figures are empty."""
    folder, picture, name = out / str(row["name"]), "", escape(str(row["name"]))
    if (folder / "overview.png").exists():
        link = PurePosixPath("/", folder.name).as_uri().removeprefix("file:///")
        target = "report.html" if (folder / "report.html").exists() else "overview.png"
        image = f'<img loading="lazy" src="{link}/overview.png" alt="">'
        picture, name = (f'<a href="{link}/{target}">{one}</a>' for one in (image, name))
    figures = {
        "photographs": _figure(row, "registered") and f"{row['registered']} of {row['views']}",
        "vertices": _figure(row, "vertices"),
        "faces": _figure(row, "faces"),
        "time": _figure(row, "seconds", " s"),
        "memory": _figure(row, "peak_memory_mb", " MB"),
    }
    cells = "".join(f'<td class="number" title="{it}">{one}</td>' for it, one in figures.items())
    status = f'<td class="{row["status"]}">{row["status"]}</td>'
    return f'<tr><td>{picture}</td><td class="name">{name}</td>{status}{cells}</tr>'


def _figure(row: Mapping[str, object], name: str, unit: str = "") -> str:
    value = row.get(name)
    return f"{value:,.0f}{unit}" if value and isinstance(value, int | float) else ""


def _reasons(rows: Sequence[Mapping[str, object]], out: Path) -> dict[str, list[str]]:
    """List why objects have no result, each reason once, with the objects' names.

    Messages that differ only in the object's folders are one.
    """
    found: dict[str, list[Mapping[str, object]]] = {}
    for row in rows:
        if message := str(row["message"]):
            for path, word in ((row["photographs"], "PHOTOS"), (out / str(row["name"]), "OUT")):
                message = message.replace(str(path), word)
            found.setdefault(message, []).append(row)
    return {
        reason if len(some) > 1 else str(some[0]["message"]): [str(row["name"]) for row in some]
        for reason, some in found.items()
    }
