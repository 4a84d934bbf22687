"""The page itself: one file, opened offline."""

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from pimper_torch.records import Silhouettes, SparseScene
from pimper_torch.report.sections import section_entries
from pimper_torch.report.views import Prediction, view_entries
from pimper_torch.viz.turn import up_world

# Places of the template that its parts go into.
_PLACE = re.compile(r"/\*\{([a-z.]+)\}\*/|\{(data|asset)\}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """One number a vertex, shown in colours from ``low`` to ``high``.

    Attributes:
        attribute: Of the asset's vertices, in small letters.
        title: On the button.
        about: Longer, shown when the button is pointed at.
        low_text: Under the lowest colour.
        high_text: Under the highest.
    """

    attribute: str
    title: str
    about: str
    low: float
    high: float
    low_text: str
    high_text: str


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
    layers: Sequence[Layer],
    summary: Mapping[str, Any],
    settings: str,
) -> None:
    """Write a page that shows a result in a browser, without a server and offline.

    Args:
        headline: What went in and what came out, in a line.
        asset: The surface as a binary glTF, in the frame of ``scene``.
        reference: View that the page begins from.
        predictions: One a view.
        layers: Of the asset's attributes; those that it lacks are not shown.
        summary: What ``summary.json`` says.
        settings: Of the run, as YAML.
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


def _read(name: str) -> str:
    return (resources.files("pimper_torch") / "report" / name).read_text(encoding="utf-8")
