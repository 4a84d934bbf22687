"""Vertex values of a surface that a page displays in colours."""

from dataclasses import dataclass

from pimper_torch.records import Mesh
from pimper_torch.records.shapes import PerVertex


@dataclass(frozen=True, slots=True, kw_only=True)
class LengthUnit:
    """The displayed unit of length: a unit of the scene is ``factor`` of it."""

    factor: float
    name: str


def length_unit(mesh: Mesh, known: str | None = None) -> LengthUnit:
    """Return the unit of lengths of a result.

    Args:
        known: Name of the scene's unit; without it, the diagonal of the mesh's bounding box is 100.
    """
    if known:
        return LengthUnit(factor=1.0, name=known)
    size = (mesh.vertices_world.amax(dim=0) - mesh.vertices_world.amin(dim=0)).norm()
    return LengthUnit(factor=100 / float(size), name="% of the object's size")


@dataclass(frozen=True, slots=True, kw_only=True)
class VertexLayer:
    """One value per vertex, in colours from ``low`` to ``high``.

    Attributes:
        attribute: Of the asset's vertices, in lower case.
        about: Description, displayed as a tooltip of the button.
    """

    attribute: str
    title: str
    about: str
    low: float = 0.0
    high: float = 1.0
    low_text: str = "0"
    high_text: str


def surface_layers(mesh: Mesh, unit: LengthUnit | None = None) -> list[VertexLayer]:
    """Return the layers of a result's surface; the mesh as written determines their ranges."""
    layers = []
    if mesh.expected_error is not None:
        about = "Estimated standard deviation of the surface along its normal"
        unit, error = unit or length_unit(mesh), mesh.expected_error
        layers.append(length_layer("_expected_error", "expected error", about, error, unit))
    if mesh.confidence is not None:
        about = "Confidence of the normals: how many lights determine them, and how well"
        layers.append(
            VertexLayer(
                attribute="_support",
                title="support",
                about=about,
                low_text="none",
                high_text="full",
            )
        )
    return layers


def length_layer(
    attribute: str, title: str, about: str, values: PerVertex, unit: LengthUnit
) -> VertexLayer:
    """Return a layer of lengths from 0 to Tukey's upper fence; outliers share one colour.

    The fence is the upper quartile plus 1.5 interquartile ranges; if no value is above it, the
    range ends at the maximum.

    Source: Tukey, Exploratory Data Analysis, 1977.
    """
    finite = values[values.isfinite()]
    high, count = 0.0, len(finite)
    if count:
        ranks = (1 + (count - 1) // 4, count - (count - 1) // 4)
        lower, upper = (float(finite.kthvalue(rank).values) for rank in ranks)
        high = min(float(finite.max()), upper + 1.5 * (upper - lower))
    text = f"{high * unit.factor:.2g} {unit.name} or more"
    return VertexLayer(attribute=attribute, title=title, about=about, high=high, high_text=text)
