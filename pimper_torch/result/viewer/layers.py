"""Quantities that colour a surface."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.geometry.surfaces import vertex_normals
from pimper_torch.ground.radiometry import linear_from_srgb
from pimper_torch.records import Mesh, Record
from pimper_torch.result.viewer.frame import Frame
from pimper_torch.result.viz.maps import base_color, normal_colors

LAYERS = {
    "lit": "Albedo under the light.",
    "shape": "Grey clay: the shape alone, without photometric normals.",
    "albedo": "Share of light it reflects.",
    "normals": "Red: to the right, green: up, blue: to the reference camera.",
}
"""Layers with their legends."""


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


def painted(mesh: Mesh, name: str, frame: Frame) -> Layer:
    """Colour a mesh by a layer.

    Args:
        frame: In which normals have colours.
    """
    own = vertex_normals(mesh.vertices_world, mesh.faces)
    carried = own if mesh.normals_world is None else mesh.normals_world
    if name == "shape":
        return Layer(colors=torch.full_like(own, 0.5).float(), normals_world=own, lit=True)
    if name == "normals":
        axes = frame.directions(carried)[:, [1, 2, 0]] * carried.new_tensor([1.0, -1.0, -1.0])
        colors = linear_from_srgb(normal_colors(axes)).float()
        return Layer(colors=colors, normals_world=carried, lit=False)
    colors = base_color(mesh).expand(-1, 3).float()
    return Layer(colors=colors, normals_world=carried, lit=name == "lit")
