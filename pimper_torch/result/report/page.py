"""The page itself: one file, opened offline."""

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pimper_torch.records import Silhouettes, SparseScene, Textured
from pimper_torch.result.asset.bake import halved
from pimper_torch.result.asset.placement import Placement
from pimper_torch.result.asset.write import write_asset
from pimper_torch.result.report.predictions import Prediction, view_entries
from pimper_torch.result.report.vertex_layers import VertexLayer
from pimper_torch.result.viz.turn import up_world
from pimper_torch.runtime.errors import some

HEAD = "<title>pimper_torch report</title>"
"""Of every page, by which a former one is known."""

# Places of the template that its parts go into.
_PLACE = re.compile(r"/\*\{([a-z.]+)\}\*/|\{(data|asset)\}")


def write_page(
    path: Path | str,
    *,
    title: str,
    headline: str,
    asset: bytes,
    scene: SparseScene,
    silhouettes: Silhouettes,
    reference: int,
    predictions: Sequence[Prediction | None],
    layers: Sequence[VertexLayer],
    summary: Mapping[str, Any],
    settings: str,
) -> None:
    """Write a page that shows a result in a browser, without a server and offline.

    Args:
        headline: What went in and what came out, in a line.
        asset: The surface as a binary glTF; its ``extras`` say where it is in ``scene``, otherwise
            it is in that frame.
        layers: Of the asset's attributes; those that it lacks are not shown.
    """
    data = {
        "title": title,
        "headline": headline,
        "reference": reference,
        "up": up_world(scene.cameras).tolist(),
        "views": view_entries(scene, silhouettes, predictions),
        "layers": [asdict(layer) for layer in layers],
        "sections": section_entries(summary, settings),
    }
    parts = {
        # No text can end the element that it stands in.
        "data": json.dumps(data, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c"),
        "asset": base64.b64encode(asset).decode("ascii"),
    }

    def part(place: re.Match[str]) -> str:
        name = place[1] or place[2]
        return parts[name] if name in parts else _read(name)

    Path(path).write_text(_PLACE.sub(part, _read("page.html")), encoding="utf-8")


def asset_within(asset: Textured, path: Path, placement: Placement) -> bytes:
    """Read an asset's file, or make one with coarser textures where it is too large for a page."""
    # Of a page of 15 MB; text takes a third more than bytes.
    if path.stat().st_size <= 7_500_000 or min(asset.base_color.shape[:2]) < 2:
        return path.read_bytes()
    with TemporaryDirectory(prefix="pimper_page_") as folder:
        smaller, coarser = Path(folder) / path.name, halved(asset)
        write_asset(coarser, smaller, placement)
        return asset_within(coarser, smaller, placement)


def _read(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


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
        [one["name"], _decibels(one["psnr_db"]), _decibels(one["psnr_matte_db"]), ""]
        for one in ({"name": "mean", **found}, *found["views"])
    ]
    columns = {"photograph": "name", "PSNR with materials, dB": "number", "matte, dB": "number"}
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
        "table": _table(columns | {"": "text"}, rows),
    }


def _decibels(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _stages(summary: Summary) -> Json:
    stages = summary["stages"]
    longest = max([stage["seconds"] for stage in stages if not stage["kept"]], default=0) or 1
    columns = {"stage": "name", "seconds": "number", "": "bar", "peak MB": "number"}
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
    if summary.get("peak_memory_stage"):
        total += f", in {summary['peak_memory_stage']}"
    return {"title": "Stages", "text": total, "table": _table(columns | {"figures": "text"}, rows)}


def _figures(stage: Mapping[str, Any]) -> str:
    aside = ("name", "seconds", "peak_memory_mb", "kept")
    return ", ".join(
        f"{name.replace('_', ' ')} {value:{',' if isinstance(value, int) else '.4g'}}"
        for name, value in stage.items()
        if name not in aside and value is not None
    )


def _left_out(summary: Summary) -> Json | None:
    idle = [entry["guard"] for entry in summary["left_out"] if not entry["count"]]
    columns = {"guard": "name", "left out": "number", "of": "number", "": "name", "reason": "text"}
    rows = [
        [
            entry["guard"],
            f"{entry['count']:,}",
            f"{entry['total']:,}",
            entry["what"],
            entry["reason"] + (f": {some(entry['names'])}" if entry["names"] else ""),
        ]
        for entry in summary["left_out"]
        if entry["count"]
    ]
    return {
        "title": "Left out, and by whom",
        "folded": True,
        "text": f"Guards that left out nothing: {', '.join(dict.fromkeys(idle)) or 'none'}.",
        "table": _table(columns, rows),
    }


def _failures(summary: Summary) -> Json | None:
    rows: Sequence[Sequence[str]] = [
        [one["stage"], f"{one['what']} {some(one['names'])}", one["reason"], one["done"]]
        for one in summary["failures"]
    ]
    columns = dict.fromkeys(("stage", "what", "reason", "done"), "text")
    return {"title": "Failed", "table": _table(columns, rows)} if rows else None


def _table(kinds: Mapping[str, str], rows: Sequence[Sequence[object]]) -> Json:
    columns = [{"title": title, "kind": kind} for title, kind in kinds.items()]
    return {"columns": columns, "rows": rows}
