"""Writing of the report page, one HTML file that works offline."""

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.pinholes import up_world
from pimper_torch.io.assets.placement import Placement
from pimper_torch.io.assets.write import write_asset
from pimper_torch.records import Mesh, Removal, Silhouettes, SparseScene, TexturedMesh
from pimper_torch.records.shapes import PerVertex, VertexMask
from pimper_torch.runtime.ledger import closing_line
from pimper_torch.stages.texturing.bake import halved
from pimper_torch.viz.report.predictions import Json, view_entries
from pimper_torch.viz.report.vertex_layers import VertexLayer, length_unit, surface_layers

HEAD = "<title>pimper_torch report</title>"
"""Part of every page; identifies a page of an earlier run."""

# Placeholders of the template.
_PLACE = re.compile(r"/\*\{([a-z.]+)\}\*/|\{(data|asset)\}")

# Keys of summary.json on the page; paths on the run's machine are excluded, as pages are shared.
_SHOWN = (
    *("verdict", "diagnosis", "warnings", "failures", "stages", "seconds", "peak_memory_mb"),
    *("peak_memory_stage", "registered", "views", "triangles", "vertices", "simplified"),
    *("reduced", "relighting"),
)


def write_page(
    path: Path | str,
    *,
    title: str,
    mesh: Mesh,
    asset: bytes,
    openness: PerVertex,
    seen: VertexMask,
    scene: SparseScene,
    silhouettes: Silhouettes,
    reference: int,
    images: Sequence[Json],
    summary: Mapping[str, Any],
    settings: Mapping[str, object],
    lights_world: Float[Tensor, "view 4"] | None = None,
    layers: Sequence[VertexLayer] = (),
) -> None:
    """Write a page that shows a result in a browser, without a server and offline.

    Args:
        mesh: The result's, as written; it determines units, and ranges of colours.
        asset: The surface as a binary glTF, whose ``extras`` contain its placement in ``scene``;
            without these, it is in that frame.
        summary: Contents of ``summary.json``; ``settings`` likewise of ``config.yaml``.
        openness: Of the asset's vertices, by :mod:`~pimper_torch.viz.report.openness`.
        seen: Whether a photograph shows each of them.
        images: Of every view, by :func:`~pimper_torch.viz.report.predictions.view_images`.
        lights_world: First-order light of every view, up to a scale; NaN where unknown.
        layers: In addition to those of ``mesh``; the page skips those that the asset lacks.
    """
    unit = length_unit(mesh, (summary.get("scale") or {}).get("unit"))
    data = {
        "title": title,
        "reference": reference,
        "up": up_world(scene.cameras).tolist(),
        "unit": asdict(unit),
        "openness": _bytes((255 * openness).round()),
        "seen": _bytes(seen),
        "views": view_entries(scene, silhouettes, images, lights_world),
        "layers": [asdict(layer) for layer in (*surface_layers(mesh, unit), *layers)],
        "summary": {name: summary.get(name) for name in _SHOWN},
        "left_out": left_out_by_pass(summary["left_out"]),
        "settings": _text(settings),
    }
    parts = {
        # No text can close the element that contains it.
        "data": json.dumps(data, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c"),
        "asset": base64.b64encode(asset).decode("ascii"),
    }

    def part(placeholder: re.Match[str]) -> str:
        name = placeholder[1] or placeholder[2]
        return parts[name] if name in parts else _read(name)

    Path(path).write_text(_PLACE.sub(part, _read("page.html")), encoding="utf-8")


def asset_within(asset: TexturedMesh, path: Path, placement: Placement) -> bytes:
    """Read an asset's file, or make one with coarser textures if it is too large for a page."""
    # Half of a page of 15 MB; base64 takes a third more than bytes.
    if path.stat().st_size <= 7_500_000 or min(asset.base_color.shape[:2]) < 2:
        return path.read_bytes()
    with TemporaryDirectory(prefix="pimper_page_") as folder:
        smaller, coarser = Path(folder) / path.name, halved(asset)
        write_asset(coarser, smaller, placement)
        return asset_within(coarser, smaller, placement)


def _bytes(values: Tensor) -> str:
    return base64.b64encode(values.byte().numpy().tobytes()).decode("ascii")


def _read(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _text(value: object) -> object:
    """Format values of settings as YAML in one line; JSON has no infinite numbers."""
    if isinstance(value, Mapping):
        return {name: _text(inner) for name, inner in value.items()}
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


# Headings of guards outside of passes, by stage.
_HEADINGS = dict.fromkeys(
    ("sfm", "silhouettes", "contours", "depth_points", "coarse", "triangulate"),
    "Cameras, silhouettes and coarse surface",
) | {"extract": "Mesh"}


def left_out_by_pass(entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """List the significant guards by pass, as ``closing_line`` selects them.

    Args:
        entries: ``left_out`` of ``summary.json``.

    Returns:
        The ``heading`` and the ``entries`` of every pass that has some.
    """
    passes: dict[str, list[Mapping[str, Any]]] = {}
    number = 1
    for entry in entries:
        stage = entry["guard"].split(".")[0]
        if closing_line([Removal(**{**entry, "names": tuple(entry["names"])})]):
            passes.setdefault(_HEADINGS.get(stage, f"Pass {number}"), []).append(entry)
        number += stage == "repair"  # ends a pass
    return [{"heading": heading, "entries": listed} for heading, listed in passes.items()]
