"""Layers: quantities displayed as colours of a surface."""

from io import BytesIO

import numpy as np
from jaxtyping import Float
from kornia.color import ColorMap
from PIL import Image
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.rigid import rotate, transform
from pimper_torch.geometry.surfaces import carried_normals
from pimper_torch.io.assets.gltf import MATTE, gltf_of
from pimper_torch.radiometry import linear_from_srgb
from pimper_torch.radiometry.base_color import base_color
from pimper_torch.records import Mesh
from pimper_torch.viz.maps import normal_colors
from pimper_torch.viz.report.vertex_layers import VertexLayer, length_unit, surface_layers

LAYERS = ("lit", "shape", "albedo", "normals")
"""Layers of colours; those of numbers are shared with the report."""
VIRIDIS: Float[Tensor, "256 3"] = ColorMap("viridis", 256).colors.T
"""sRGB from low values, dark violet, to high ones, bright yellow."""
_UNLIT = MATTE | {"extensions": {"KHR_materials_unlit": {}}}


def layers_of(mesh: Mesh) -> list[str]:
    """Return the names of a surface's layers."""
    colors = [name for name in LAYERS if name != "albedo" or mesh.albedo is not None]
    return colors + [layer.title for layer in surface_layers(mesh)]


def painted(
    mesh: Mesh, name: str, viewer_from_world: Float[Tensor, "4 4"], unit: str | None = None
) -> tuple[bytes, VertexLayer | None]:
    """Colour a surface by one of its layers.

    Args:
        viewer_from_world: A similarity; the viewer's x points to the reference camera, z is up.
        unit: Of the mesh, if its scale is known.

    Returns:
        A GLB in the viewer's frame, and the layer if it is one of numbers.
    """
    if name == "shape":
        mesh = mesh.replace(normals_world=None, albedo=None)
    normals = normalize(rotate(viewer_from_world, carried_normals(mesh).double()), dim=1)
    colors = base_color(mesh).expand(-1, 3)
    if name == "normals":
        normals_cam = normals[:, [1, 2, 0]] * normals.new_tensor([1.0, -1.0, -1.0])
        colors = linear_from_srgb(normal_colors(normals_cam))
    layers = {layer.title: layer for layer in surface_layers(mesh, length_unit(mesh, unit))}
    layer = layers.get(name)
    if layer is not None:
        values = mesh.confidence if layer.attribute == "_support" else mesh.expected_error
        assert values is not None
        fractions = ((values - layer.low) / (layer.high - layer.low or 1)).nan_to_num(1)
        colors = linear_from_srgb(VIRIDIS[(255 * fractions.clamp(0, 1)).round().long()])
    attributes = {
        "POSITION": transform(viewer_from_world, mesh.vertices_world.double()).numpy(),
        "NORMAL": normals.numpy(),
        "COLOR_0": colors.float().numpy(),
    }
    material = MATTE if name in ("lit", "shape") else _UNLIT
    return gltf_of(attributes, mesh.faces.numpy(), material), layer


def color_bar(layer: VertexLayer) -> str:
    """Return HTML of a colour bar between the texts of a layer's limits."""
    stops = ", ".join(f"rgb({r} {g} {b})" for r, g, b in (255 * VIRIDIS[::51]).int().tolist())
    return (
        '<div style="display: flex; gap: 6px; align-items: center; padding: 2px 10px; '
        f'font-size: 12px"><span>{layer.low_text}</span><i style="flex: 1; min-width: 60px; '
        f'height: 10px; border-radius: 3px; background: linear-gradient(90deg, {stops})"></i>'
        f"<span>{layer.high_text}</span></div>"
    )


def pane(image: np.ndarray, corners: np.ndarray, opacity: float) -> bytes:
    """Return a GLB of a translucent photograph.

    Args:
        image: 8-bit sRGB.
        corners: Clockwise from the upper left.
    """
    file, corner = BytesIO(), np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    Image.fromarray(image).save(file, "JPEG", quality=90)
    surface = {"baseColorTexture": {"index": 0}, "baseColorFactor": [1.0, 1.0, 1.0, opacity]}
    material = {**_UNLIT, "alphaMode": "BLEND", "pbrMetallicRoughness": surface}
    attributes = {"POSITION": corners, "TEXCOORD_0": corner}
    return gltf_of(attributes, np.array([[0, 1, 2], [0, 2, 3]]), material, [file.getvalue()])
