"""The table of a batch, as CSV and as a page with images."""

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from html import escape
from importlib import resources
from pathlib import Path, PurePosixPath
from string import Template

from pimper_torch.cli.batches.objects import CSV, HTML
from pimper_torch.cli.batches.task import Outcome
from pimper_torch.export.result_folder.files import file_written_whole

_COLUMNS = (
    *("name", "status", "tries", "seconds", "views", "registered", "vertices", "faces"),
    *("peak_memory_mb", "place", "message", "photographs"),
)
SIGNS = {CSV: "name,status,tries,seconds", HTML: "<!-- pimper batch -->"}
"""Text that identifies files of a batch; only files that contain it are replaced."""

_WITH_RESULT = ("ended", "kept")


def write_table(outcomes: Sequence[Outcome], out: Path, photos: Mapping[str, Path | str]) -> None:
    """Write ``batch.csv`` and ``batch.html``, with images that link to the objects' reports."""
    rows = [_row(entry, out) | {"photographs": str(photos[entry.name])} for entry in outcomes]
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, _COLUMNS, restval="")
    table.writeheader()
    table.writerows(rows)
    for name, content in ((CSV, text.getvalue()), (HTML, _page(rows, out))):
        with file_written_whole(out / name) as fresh:
            fresh.write_text(content, encoding="utf-8", newline="")


def _row(outcome: Outcome, out: Path) -> dict[str, object]:
    """Return the outcome of an object and figures of its result, by column."""
    row: dict[str, object] = {}
    if outcome.status in _WITH_RESULT:
        summary = json.loads((out / outcome.name / "summary.json").read_text(encoding="utf-8"))
        row = {name: summary.get(name, "") for name in _COLUMNS}
    seconds = outcome.seconds or float(str(row.get("seconds") or 0))
    row |= asdict(outcome) | {"seconds": seconds}
    return {key: round(cell, 1) if isinstance(cell, float) else cell for key, cell in row.items()}


def _page(rows: Sequence[Mapping[str, object]], out: Path) -> str:
    package = resources.files("pimper_torch")
    style = package / "viz" / "report" / "page.css"
    page = Template((package / "cli" / "batches" / "table.html").read_text(encoding="utf-8"))
    statuses = [str(row["status"]) for row in rows]
    reasons = _reasons(rows, out)
    return page.substitute(
        title=f"{sum(status in _WITH_RESULT for status in statuses)} of {len(rows)} objects",
        counts=", ".join(f"{statuses.count(kind)} {kind}" for kind in dict.fromkeys(statuses)),
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
    """Return an object's row of the page; figures are empty without a result."""
    folder, picture, name = out / str(row["name"]), "", escape(str(row["name"]))
    if (folder / "overview.png").exists():
        link = PurePosixPath("/", folder.name).as_uri().removeprefix("file:///")
        target = "report.html" if (folder / "report.html").exists() else "overview.png"
        image = f'<img loading="lazy" src="{link}/overview.png" alt="">'
        picture, name = (f'<a href="{link}/{target}">{label}</a>' for label in (image, name))
    figures = {
        "photographs": _figure(row, "registered") and f"{row['registered']} of {row['views']}",
        "vertices": _figure(row, "vertices"),
        "faces": _figure(row, "faces"),
        "time": _figure(row, "seconds", " s"),
        "memory": _figure(row, "peak_memory_mb", " MB"),
    }
    cells = "".join(f'<td class="number" title="{key}">{it}</td>' for key, it in figures.items())
    status = f'<td class="{row["status"]}">{row["status"]}</td>'
    return f'<tr><td>{picture}</td><td class="name">{name}</td>{status}{cells}</tr>'


def _figure(row: Mapping[str, object], name: str, unit: str = "") -> str:
    value = row.get(name)
    return f"{value:,.0f}{unit}" if value and isinstance(value, int | float) else ""


def _reasons(rows: Sequence[Mapping[str, object]], out: Path) -> dict[str, list[str]]:
    """Return the names of the objects without result, by reason.

    Messages that differ only in the object's folders are the same reason.
    """
    by_reason: dict[str, list[Mapping[str, object]]] = {}
    for row in rows:
        if message := str(row["message"]):
            for path, word in ((row["photographs"], "PHOTOS"), (out / str(row["name"]), "OUT")):
                message = message.replace(str(path), word)
            by_reason.setdefault(message, []).append(row)
    return {
        reason if len(group) > 1 else str(group[0]["message"]): [str(row["name"]) for row in group]
        for reason, group in by_reason.items()
    }
