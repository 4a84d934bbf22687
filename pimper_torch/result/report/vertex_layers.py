"""Numbers of a surface's vertices that a page shows in colours."""

from dataclasses import dataclass

from pimper_torch.ground.shapes import PerVertex
from pimper_torch.records import Mesh


@dataclass(frozen=True, slots=True, kw_only=True)
class VertexLayer:
    """One number a vertex, shown in colours from ``low`` to ``high``.

    Attributes:
        attribute: Of the asset's vertices, in small letters.
        about: Longer, shown when the button is pointed at.
    """

    attribute: str
    title: str
    about: str
    low: float
    high: float
    low_text: str
    high_text: str


def surface_layers(mesh: Mesh) -> list[VertexLayer]:
    """Return the layers of what a result's surface says of itself."""
    layers = []
    if mesh.expected_error is not None:
        about = "Standard deviation of the surface along its normal, as the run expects it"
        layers.append(length_layer("_expected_error", "expected error", about, mesh.expected_error))
    if mesh.confidence is not None:
        layers.append(
            VertexLayer(
                attribute="_support",
                title="support",
                about="Confidence of the normals: how many lights told them, and how well",
                low=0.0,
                high=1.0,
                low_text="none",
                high_text="full",
            )
        )
    return layers


def length_layer(
    attribute: str, title: str, about: str, values: PerVertex, unit: str = "units"
) -> VertexLayer:
    """Return a layer of lengths, from 0 to what nearly all are below."""
    known = values[values.isfinite()]
    rank = max(1, len(known) - len(known) // 50)  # a few would take all colours
    high = float(known.kthvalue(rank).values) if len(known) else 0.0
    return VertexLayer(
        attribute=attribute,
        title=title,
        about=about,
        low=0.0,
        high=high,
        low_text="0",
        high_text=f"{high:.3g} {unit} or more",
    )
