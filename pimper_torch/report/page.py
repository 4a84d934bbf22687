"""The page itself: one file, opened offline."""

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pimper_torch.asset.bake import Textured
from pimper_torch.asset.write import write_asset
from pimper_torch.records import Silhouettes, SparseScene
from pimper_torch.report.predictions import Prediction
from pimper_torch.report.sections import section_entries
from pimper_torch.report.vertex_layers import VertexLayer
from pimper_torch.report.view_entries import view_entries
from pimper_torch.viz.turn import up_world

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
        asset: The surface as a binary glTF, in the frame of ``scene``.
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


def asset_within(asset: Textured, path: Path) -> bytes:
    """Read an asset's file, or make one with coarser textures where it is too large for a page."""
    # Of a page of 15 MB; text takes a third more than bytes.
    if path.stat().st_size <= 7_500_000 or min(asset.base_color.shape[:2]) < 2:
        return path.read_bytes()
    with TemporaryDirectory(prefix="pimper_page_") as folder:
        smaller, coarser = Path(folder) / path.name, asset.halved()
        write_asset(coarser, smaller)
        return asset_within(coarser, smaller)


def _read(name: str) -> str:
    return (resources.files("pimper_torch") / "report" / name).read_text(encoding="utf-8")
