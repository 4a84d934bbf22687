"""The tables below a page's surface: what a run took, left out, and warned of."""

from collections.abc import Mapping, Sequence
from typing import Any

from pimper_torch.errors import some

Json = dict[str, object]
Summary = Mapping[str, Any]


def section_entries(summary: Summary, settings: str) -> list[Json]:
    """List the sections of a page, from what ``summary.json`` says."""
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
    """Return the section on errors of predicted photographs, with materials and without."""
    found = summary.get("relighting")
    if not found or found["psnr_db"] is None:
        return None
    held_out = found["photographs"] == "held out"
    rows = [
        [one["name"], _decibels(one["psnr_db"]), _decibels(one["psnr_matte_db"])]
        for one in ({"name": "mean", **found}, *found["views"])
    ]
    columns = [
        {"title": "photograph", "kind": "name"},
        {"title": "PSNR with materials, dB", "kind": "number"},
        {"title": "matte, dB", "kind": "number"},
        {"title": "", "kind": "text"},
    ]
    materials = "; ".join(
        f"{100 * one['vertices']:.0f} % metallic {one['metallic']:.2g}, roughness "
        f"{one['roughness']:.2g}, specular {one['specular']:.2g}"
        for one in found["materials"]
    )
    whose = "held out of the run" if held_out else "that the surface was made from"
    textured = _decibels(found.get("psnr_textured_db"))
    whose += f"; with the asset's textures {textured} dB on average" if textured else ""
    return {
        "title": "Photographs predicted from the surface",
        "folded": True,
        "text": f"Each under its own fitted light, of photographs {whose}. Materials: {materials}.",
        "table": {"columns": columns, "rows": [[*row, ""] for row in rows]},
    }


def _decibels(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


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
    return ", ".join(
        f"{name.replace('_', ' ')} {value:,}"
        if isinstance(value, int)
        else f"{name.replace('_', ' ')} {value:.4g}"
        for name, value in told.items()
    )


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
