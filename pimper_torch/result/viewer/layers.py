"""Layers: what the colours of a surface show."""

from jaxtyping import Float
from kornia.color import ColorMap
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.rigid import rotate, transform
from pimper_torch.ground.radiometry import linear_from_srgb
from pimper_torch.records import Mesh
from pimper_torch.result.asset.gltf import MATTE, gltf_of
from pimper_torch.result.report.vertex_layers import surface_layers
from pimper_torch.result.viz.maps import base_color, carried_normals, normal_colors

LAYERS = ("lit", "shape", "albedo", "normals")
"""Of colours; those of numbers are the report's."""
VIRIDIS: Float[Tensor, "256 3"] = ColorMap("viridis", 256).colors.T
"""sRGB of low numbers, dark violet, to high ones, bright yellow."""


def layers_of(mesh: Mesh) -> list[str]:
    """List the layers of what a surface carries."""
    colors = [name for name in LAYERS if name != "albedo" or mesh.albedo is not None]
    return colors + [layer.title for layer in surface_layers(mesh)]


def painted(mesh: Mesh, name: str, viewer_from_world: Float[Tensor, "4 4"]) -> tuple[bytes, str]:
    """Colour a surface by one of its layers.

    Args:
        viewer_from_world: A similarity. x of the viewer points to the reference camera, z up.

    Returns:
        A GLB in the viewer's frame, and the range of a layer of numbers.
    """
    if name == "shape":
        mesh = mesh.replace(normals_world=None, albedo=None)
    normals = normalize(rotate(viewer_from_world, carried_normals(mesh).double()), dim=1)
    colors, legend = base_color(mesh).expand(-1, 3), ""
    if name == "normals":
        right_down_ahead = normals[:, [1, 2, 0]] * normals.new_tensor([1.0, -1.0, -1.0])
        colors = linear_from_srgb(normal_colors(right_down_ahead))
    for layer in surface_layers(mesh):
        if layer.title == name:
            values = mesh.confidence if layer.attribute == "_support" else mesh.expected_error
            assert values is not None
            shares = ((values - layer.low) / (layer.high - layer.low or 1)).nan_to_num(1)
            colors = linear_from_srgb(VIRIDIS[(255 * shares.clamp(0, 1)).round().long()])
            legend = f"{layer.about}, from {layer.low_text} to {layer.high_text}."
    attributes = {
        "POSITION": transform(viewer_from_world, mesh.vertices_world.double()).numpy(),
        "NORMAL": normals.numpy(),
        "COLOR_0": colors.float().numpy(),
    }
    unlit = MATTE | {"extensions": {"KHR_materials_unlit": {}}}
    material = MATTE if name in ("lit", "shape") else unlit
    return gltf_of(attributes, mesh.faces.numpy(), material), legend
