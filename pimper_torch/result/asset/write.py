"""Textured meshes as files: GLB, and OBJ with a material."""

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from pimper_torch.ground.geometry.local_frame import NO_OFFSET, Offset
from pimper_torch.ground.radiometry import to_bytes
from pimper_torch.ground.shapes import Scalars
from pimper_torch.records import Textured
from pimper_torch.result.asset.gltf import MATTE, gltf_of

_SPECULAR = "KHR_materials_specular"


def write_asset(
    asset: Textured,
    path: Path | str,
    offset_world: Offset = NO_OFFSET,
    more: Mapping[str, Float[Tensor, " copy"]] | None = None,
) -> None:
    """Write a GLB whose vertices tell ``_EXPECTED_ERROR`` and ``_SUPPORT`` (confidence), if known.

    Args:
        offset_world: Of the node; see ``SparseScene.offset_world``.
    """
    mesh, images = asset.mesh, [_png(asset.base_color), _png(asset.normal)]
    told = {"_EXPECTED_ERROR": mesh.expected_error, "_SUPPORT": mesh.confidence, **(more or {})}
    attributes = {
        "POSITION": mesh.vertices_world,
        "NORMAL": asset.normals,
        "TANGENT": asset.tangent,
        "TEXCOORD_0": asset.uv,
        **{name: values for name, values in told.items() if values is not None},
    }
    surface = MATTE["pbrMetallicRoughness"] | {"baseColorTexture": {"index": 0}}
    material = MATTE | {"pbrMetallicRoughness": surface, "normalTexture": {"index": 1}}
    if asset.reflectance is not None:
        images += _reflect(material, asset.reflectance, len(images))
    arrays = {name: values.numpy() for name, values in attributes.items()}
    data = gltf_of(arrays, mesh.faces.numpy(), material, images, offset_world)
    Path(path).write_bytes(data)


def _reflect(
    material: dict[str, Any], reflectance: Float[Tensor, "height width 3"], first: int
) -> list[bytes]:
    """Put factors, and textures where they differ, in a material; return the images of these."""
    metallic, roughness, specular = reflectance.unbind(dim=-1)
    strongest = float(specular.max().clamp_min(1))
    surface = material["pbrMetallicRoughness"]
    extension: dict[str, Any] = {"specularColorFactor": [strongest] * 3}
    material["extensions"] = {_SPECULAR: extension}
    if float((reflectance - reflectance[0, 0]).abs().max()) < 1 / 255:
        surface["metallicFactor"] = float(metallic[0, 0])
        surface["roughnessFactor"] = float(roughness[0, 0])
        extension["specularFactor"] = min(1.0, float(specular[0, 0]))
        return []
    surface["metallicFactor"] = surface["roughnessFactor"] = 1.0
    surface["metallicRoughnessTexture"] = {"index": first}
    extension["specularTexture"] = extension["specularColorTexture"] = {"index": first + 1}
    occlusion = torch.ones_like(metallic)
    colored = to_bytes(specular.clamp_min(1)[..., None].expand(-1, -1, 3) / strongest)
    return [
        _png(_levels(torch.stack([occlusion, roughness, metallic], dim=-1))),
        _png(torch.cat([colored, _levels(specular.clamp_max(1)[..., None])], dim=-1)),
    ]


def _levels(values: Scalars) -> UInt8[Tensor, "*batch"]:
    return (255 * values.clamp(0, 1)).round().to(torch.uint8)


def _png(picture: UInt8[Tensor, "height width channel"]) -> bytes:
    file = BytesIO()
    # With 6 the two pictures take twice as long and are a twentieth smaller.
    Image.fromarray(picture.numpy()).save(file, "PNG", compress_level=3)
    return file.getvalue()


def write_asset_obj(asset: Textured, path: Path | str, offset_world: Offset = NO_OFFSET) -> None:
    """Write an OBJ; beside it, under its name, the ``.mtl`` and two PNG files that it refers to.

    Args:
        offset_world: Added to the vertices; see ``SparseScene.offset_world``.
    """
    path, mesh = Path(path), asset.mesh
    albedo, normal = (path.with_name(f"{path.stem}_{name}.png") for name in ("albedo", "normal"))
    albedo.write_bytes(_png(asset.base_color))
    normal.write_bytes(_png(asset.normal))
    path.with_suffix(".mtl").write_text(
        f"newmtl surface\nKd 1 1 1\nKs 0 0 0\nPm 0\nPr 1\nmap_Kd {albedo.name}\n"
        f"norm {normal.name}\n",
        encoding="utf-8",
    )
    digits = 9 if offset_world == NO_OFFSET else 15
    corners = mesh.faces.repeat_interleave(3, dim=1) + 1
    places = mesh.vertices_world.double() + torch.tensor(offset_world).double()
    upward = asset.uv * asset.uv.new_tensor([1.0, -1.0]) + asset.uv.new_tensor([0.0, 1.0])
    with path.open("w", encoding="utf-8") as file:
        file.write(f"mtllib {path.stem}.mtl\nusemtl surface\n")
        for word, template, rows in (
            ("v", f"%.{digits}g " * 3, places),
            ("vt", "%.7g %.7g", upward),
            ("vn", "%.6g %.6g %.6g", asset.normals),
            ("f", "%d/%d/%d %d/%d/%d %d/%d/%d", corners),
        ):
            np.savetxt(file, rows.numpy(), fmt=f"{word} {template.rstrip()}")
