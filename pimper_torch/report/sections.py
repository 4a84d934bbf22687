"""The tables below a page's surface: what a run took, left out, and warned of."""

from collections.abc import Mapping, Sequence
from typing import Any

from pimper_torch.errors import some

Json = dict[str, object]
Summary = Mapping[str, Any]


def section_entries(summary: Summary, settings: str) -> list[Json]:
    """List the sections of a page, from what ``summary.json`` says.

    Args:
        settings: Of the run, as YAML.
    """
    found = [
        _warnings(summary),
        _relighting(summary),
        _stages(summary),
        _left_out(summary),
        _failures(summary),
        {"title": "Settings", "folded": True, "code": settings},
    ]
    return [section for section in found if section is not None]


def _warnings(summary: Summary) -> Json:
    messages = [*summary.get("warnings", ())]
    if summary.get("doubt"):
        messages.insert(0, summary["doubt"])
    if not messages:
        return {"title": "Warnings", "text": "None."}
    return {"title": "Warnings", "items": messages}


def _relighting(summary: Summary) -> Json | None:
    figures = summary.get("relighting")
    if not figures:
        return None
    rows = [[name, f"{value:.2f} dB"] for name, value in figures["psnr_db"].items()]
    columns = [{"title": "prediction", "kind": "text"}, {"title": "PSNR", "kind": "number"}]
    return {
        "title": "Photographs predicted from the surface",
        "text": figures["of"],
        "table": {"columns": columns, "rows": rows},
    }


def _stages(summary: Summary) -> Json:
    stages = summary["stages"]
    longest = max([stage["seconds"] for stage in stages if not stage["kept"]], default=0) or 1
    columns = [
        {"title": "stage", "kind": "name"},
        {"title": "seconds", "kind": "number"},
        {"title": "", "kind": "bar"},
        {"title": "peak MB", "kind": "number"},
        {"title": "figures", "kind": "text"},
    ]
    rows = [
        [
            stage["name"],
            "kept" if stage["kept"] else f"{stage['seconds']:.1f}",
            0 if stage["kept"] else stage["seconds"] / longest,
            f"{stage['peak_memory_mb']:.0f}",
            _figures(stage),
        ]
        for stage in stages
    ]
    total = f"{summary['seconds']:.0f} s, {summary['peak_memory_mb'] or 0:.0f} MB at most"
    return {"title": "Stages", "text": total, "table": {"columns": columns, "rows": rows}}


def _figures(stage: Mapping[str, Any]) -> str:
    aside = ("name", "seconds", "peak_memory_mb", "kept")
    told = {name: value for name, value in stage.items() if name not in aside and value is not None}
    return ", ".join(f"{name.replace('_', ' ')} {value:,.6g}" for name, value in told.items())


def _left_out(summary: Summary) -> Json | None:
    acted = [entry for entry in summary["left_out"] if entry["count"]]
    idle = [entry["guard"] for entry in summary["left_out"] if not entry["count"]]
    columns = [
        {"title": "guard", "kind": "name"},
        {"title": "left out", "kind": "number"},
        {"title": "of", "kind": "number"},
        {"title": "", "kind": "name"},
        {"title": "reason", "kind": "text"},
    ]
    rows = [
        [
            entry["guard"],
            f"{entry['count']:,}",
            f"{entry['total']:,}",
            entry["what"],
            entry["reason"] + (f": {some(entry['names'])}" if entry["names"] else ""),
        ]
        for entry in acted
    ]
    return {
        "title": "Left out, and by whom",
        "folded": True,
        "text": f"Guards that left out nothing: {', '.join(dict.fromkeys(idle)) or 'none'}.",
        "table": {"columns": columns, "rows": rows},
    }


def _failures(summary: Summary) -> Json | None:
    rows: Sequence[Sequence[str]] = [
        [one["stage"], f"{one['what']} {some(one['names'])}", one["reason"], one["done"]]
        for one in summary["failures"]
    ]
    columns = [{"title": title, "kind": "text"} for title in ("stage", "what", "reason", "done")]
    return {"title": "Failed", "table": {"columns": columns, "rows": rows}} if rows else None
