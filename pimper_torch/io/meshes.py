"""Meshes as files that other programs open."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.radiometry import to_bytes
from pimper_torch.records import Mesh
from pimper_torch.viz.maps import albedo_scale


def write_ply(mesh: Mesh, path: Path) -> None:
    """Write a binary PLY: vertex normals, albedo as 8-bit sRGB colour, ``confidence``."""
    colors = None if mesh.albedo is None else to_bytes(_colors(mesh)).cpu().numpy()
    attributes = {}
    if mesh.confidence is not None:
        attributes["confidence"] = mesh.confidence.detach().cpu().float().numpy()
    plain = _trimesh(mesh, colors)
    plain.vertex_attributes.update(attributes)
    path.write_bytes(trimesh.exchange.ply.export_ply(plain, vertex_normal=True))


def write_glb(mesh: Mesh, path: Path) -> None:
    """Write a binary glTF of the same frame, normals and colours as the PLY.

    glTF wants colours linear, so these are albedo itself; the material is matte and seen
    from both sides. glTF calls y up: viewers show the model as it lies in the world frame
    of structure from motion, whose up is arbitrary.
    """
    colors = None if mesh.albedo is None else (255 * _colors(mesh)).round().cpu().numpy()
    scene = trimesh.Scene(_trimesh(mesh, None if colors is None else colors.astype(np.uint8)))
    postprocess: Callable[[dict[str, Any]], None] = _make_matte
    path.write_bytes(
        trimesh.exchange.gltf.export_glb(
            scene, include_normals=True, tree_postprocessor=postprocess
        )
    )


def _colors(mesh: Mesh) -> Float[Tensor, "vertex 3"]:
    assert mesh.albedo is not None
    scaled = mesh.albedo.detach() * albedo_scale(mesh)
    return scaled.nan_to_num(0).clamp(0, 1).expand(-1, 3)


def _trimesh(mesh: Mesh, colors: np.ndarray | None) -> trimesh.Trimesh:
    normals = mesh.normals_world
    if normals is None:
        normals = vertex_normals(mesh.vertices_world, mesh.faces)
    return trimesh.Trimesh(
        vertices=mesh.vertices_world.detach().cpu().double().numpy(),
        faces=mesh.faces.cpu().numpy(),
        vertex_normals=normals.detach().cpu().double().numpy(),
        vertex_colors=colors,
        process=False,  # keeps the order and number of vertices
    )


def _make_matte(tree: dict[str, Any]) -> None:
    """Give every primitive one material, in place as trimesh wants it; glTF's own is metal."""
    tree["materials"] = [
        {
            "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
            "doubleSided": True,
        }
    ]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
