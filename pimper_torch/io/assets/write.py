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

from pimper_torch.io.assets.gltf import MATTE, gltf_of
from pimper_torch.io.assets.mesh_files import TextureFormat
from pimper_torch.io.assets.placement import Placement
from pimper_torch.radiometry import to_bytes
from pimper_torch.records import TexturedMesh
from pimper_torch.records.shapes import Scalars

_Image = UInt8[Tensor, "height width *channel"]
_SPECULAR = "KHR_materials_specular"
# Of JPEG and WebP: colours of the skull are off by 1.6 and 1.8 of 255 (root mean square), in
# 46 % and 23 % of the PNG's bytes.
_QUALITY = 95


def write_asset(
    asset: TexturedMesh,
    path: Path | str,
    placement: Placement | None = None,
    texture: TextureFormat = "png",
    more: Mapping[str, Float[Tensor, " copy"]] | None = None,
) -> None:
    """Write a GLB whose vertices have ``_EXPECTED_ERROR`` and ``_SUPPORT`` (confidence), if known.

    Unless albedo is determined everywhere, the material's ``extras`` name the texture
    ``albedo_uncertainty``: black if determined, grey if not, white if inpainted.

    Args:
        placement: Of the file; by default, the file is in the frame of the asset's mesh.
        texture: Of the base colour; JPEG and WebP are lossy. Other images are lossless: PNG, or
            WebP. Programs need ``EXT_texture_webp`` for WebP.
        more: Additional vertex attributes, by name.
    """
    mesh = asset.mesh
    vertices, normals, along = mesh.vertices_world, asset.normals, asset.tangent[:, :3]
    if placement is not None:
        along = placement.placed(vertices, along)[1]
        vertices, normals = placement.placed(vertices, normals)
    attributes = {
        "POSITION": vertices,
        "NORMAL": normals,
        "TANGENT": torch.cat([along, asset.tangent[:, 3:]], dim=1),
        "TEXCOORD_0": asset.uv,
        "_EXPECTED_ERROR": mesh.expected_error,
        "_SUPPORT": mesh.confidence,
        **(more or {}),
    }
    images = [_encoded(asset.base_color, texture, lossless=False), _encoded(asset.normal, texture)]
    surface = MATTE["pbrMetallicRoughness"] | {"baseColorTexture": {"index": 0}}
    material = MATTE | {"pbrMetallicRoughness": surface, "normalTexture": {"index": 1}}
    if asset.reflectance is not None:
        maps = _reflect(material, asset.reflectance, len(images))
        images += [_encoded(image, texture) for image in maps]
    if bool(asset.uncertainty.any()):
        material["extras"] = {"albedo_uncertainty": {"index": len(images)}}
        images.append(_encoded(asset.uncertainty, "png"))
    data = gltf_of(
        {name: values.numpy() for name, values in attributes.items() if values is not None},
        mesh.faces.numpy(),
        material,
        images,
        placement=placement,
    )
    Path(path).write_bytes(data)


def _reflect(
    material: dict[str, Any], reflectance: Float[Tensor, "height width 3"], first: int
) -> list[_Image]:
    """Add factors, or textures where they vary, to a material; return the textures' images."""
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
        _as_bytes(torch.stack([occlusion, roughness, metallic], dim=-1)),
        torch.cat([colored, _as_bytes(specular.clamp_max(1)[..., None])], dim=-1),
    ]


def _as_bytes(values: Scalars) -> UInt8[Tensor, "*batch"]:
    return (255 * values.clamp(0, 1)).round().to(torch.uint8)


def _encoded(image: _Image, texture: TextureFormat, *, lossless: bool = True) -> bytes:
    """Return an image's file; JPEG is never lossless."""
    file, pillow = BytesIO(), Image.fromarray(image.numpy())
    if texture == "webp":
        pillow.save(file, "WEBP", lossless=lossless, quality=_QUALITY)
    elif texture == "jpeg" and not lossless:
        pillow.save(file, "JPEG", quality=_QUALITY, subsampling=0)
    else:
        # With 6, two images take twice as long and are 5 % smaller.
        pillow.save(file, "PNG", compress_level=3)
    return file.getvalue()


def write_asset_obj(asset: TexturedMesh, path: Path | str, placement: Placement) -> None:
    """Write an OBJ, its ``.mtl`` and the two PNG files that this refers to.

    The first lines are comments with values that undo the placement.
    """
    path, name = Path(path), "_".join(placement.name.split())
    albedo, normal = (path.with_name(f"{path.stem}_{name}.png") for name in ("albedo", "normal"))
    albedo.write_bytes(_encoded(asset.base_color, "png"))
    normal.write_bytes(_encoded(asset.normal, "png"))
    path.with_suffix(".mtl").write_text(
        f"newmtl {name}\nKd 1 1 1\nKs 0 0 0\nPm 0\nPr 1\nmap_Kd {albedo.name}\n"
        f"norm {normal.name}\n",
        encoding="utf-8",
    )
    corners = asset.mesh.faces.repeat_interleave(3, dim=1) + 1
    vertices, normals = placement.placed(asset.mesh.vertices_world, asset.normals)
    upward = asset.uv * asset.uv.new_tensor([1.0, -1.0]) + asset.uv.new_tensor([0.0, 1.0])
    with path.open("w", encoding="utf-8") as file:
        file.writelines(f"# {key}: {value}\n" for key, value in placement.extras.items())
        file.write(f"mtllib {path.stem}.mtl\no {name}\nusemtl {name}\n")
        for word, template, rows in (
            ("v", "%.9g %.9g %.9g", vertices),
            ("vt", "%.7g %.7g", upward),
            ("vn", "%.6g %.6g %.6g", normals),
            ("f", "%d/%d/%d %d/%d/%d %d/%d/%d", corners),
        ):
            np.savetxt(file, rows.numpy(), fmt=f"{word} {template}")
