"""Quantities that colour a surface."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.radiometry import linear_from_srgb
from pimper_torch.records import Mesh, Record
from pimper_torch.viewer.frame import Frame
from pimper_torch.viz.heatmap import ErrorScale, error_picture
from pimper_torch.viz.maps import base_color, normal_colors

LAYERS = ("lit", "shape", "albedo", "normals", "expected error", "support")
_FIELDS = {"lit": "albedo", "albedo": "albedo"}
_FIELDS |= {"expected error": "expected_error", "support": "confidence"}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Layer(Record):
    """Colours of a surface.

    Attributes:
        colors: Linear, in [0, 1].
        lit: Whether light changes the colours.
    """

    colors: Float[Tensor, "vertex 3"]
    normals_world: Float[Tensor, "vertex 3"]
    lit: bool
    legend: str


def layers_of(mesh: Mesh) -> tuple[str, ...]:
    """Name the layers that a mesh can be coloured by."""
    return tuple(
        name for name in LAYERS if name not in _FIELDS or getattr(mesh, _FIELDS[name]) is not None
    )


def painted(mesh: Mesh, name: str, frame: Frame, unit: str = "scene units") -> Layer:
    """Colour a mesh.

    Args:
        frame: In which normals have colours.
    """
    own = vertex_normals(mesh.vertices_world, mesh.faces)
    carried = own if mesh.normals_world is None else mesh.normals_world
    if name in ("lit", "albedo"):
        colors = base_color(mesh).expand(-1, 3)
        legend = "Albedo under the light." if name == "lit" else "Share of light it reflects."
    elif name == "shape":
        colors = torch.full_like(own, 0.5)
        legend = "Grey clay: the shape alone, without photometric normals."
    elif name == "normals":
        axes = frame.directions(carried)[:, [1, 2, 0]] * carried.new_tensor([1.0, -1.0, -1.0])
        colors = linear_from_srgb(normal_colors(axes))
        legend = "Red: to the right, green: up, blue: to the reference camera."
    elif name == "support":
        assert mesh.confidence is not None
        colors = _mapped(mesh.confidence, ErrorScale(clip=1.0, unit="1"))
        legend = "How well photographs determine the normal: violet 0 to yellow 1."
    else:
        assert mesh.expected_error is not None
        known = mesh.expected_error[mesh.expected_error.isfinite()]
        rank = max(1, round(0.95 * len(known)))
        clip = float(known.kthvalue(rank).values) if len(known) else 1.0
        colors = _mapped(mesh.expected_error, ErrorScale(clip=clip, unit=unit))
        legend = f"Standard error across the surface: violet 0 to yellow {clip:.2g} {unit} or more."
    return Layer(
        colors=colors.float(),
        normals_world=own if name == "shape" else carried,
        lit=name in ("lit", "shape"),
        legend=legend,
    )


def _mapped(values: Float[Tensor, " vertex"], scale: ErrorScale) -> Float[Tensor, "vertex 3"]:
    """Return linear colours of numbers; white where there is none."""
    return linear_from_srgb(torch.from_numpy(error_picture(values[None], scale)[0]))
