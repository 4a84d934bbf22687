"""Textured meshes as USDZ, by usd-core, an optional dependency."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from PIL import Image

from pimper_torch.io.assets.placement import Placement
from pimper_torch.records import TexturedMesh


def write_usdz(asset: TexturedMesh, path: Path | str, placement: Placement) -> None:
    """Write a USDZ, for Apple's devices and for film: one mesh with albedo and normal map.

    y is up, and lengths are in metres; ``customData`` of the mesh undoes the placement. The surface
    is matte.
    """
    from pxr import Sdf, Usd, UsdGeom, UsdUtils

    with TemporaryDirectory(prefix="pimper_usd_") as folder:
        layer = Path(folder) / "asset.usdc"
        stage = Usd.Stage.CreateNew(str(layer))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/asset").GetPrim())
        surface = _define_mesh(stage, asset, placement)
        for name, image in (("albedo", asset.base_color), ("normal", asset.normal)):
            Image.fromarray(image.numpy()).save(Path(folder) / f"{name}.png")
        _bind_material(stage, surface)
        stage.GetRootLayer().Save()
        UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(path))


def _define_mesh(stage: Any, asset: TexturedMesh, placement: Placement) -> Any:  # noqa: ANN401
    """Define the mesh with its texture coordinates; return its prim."""
    from pxr import Sdf, UsdGeom, Vt

    vertices, normals = placement.placed(asset.mesh.vertices_world, asset.normals)
    uv = asset.uv * asset.uv.new_tensor([1.0, -1.0]) + asset.uv.new_tensor([0.0, 1.0])
    mesh = UsdGeom.Mesh.Define(stage, "/asset/surface")
    mesh.GetPrim().SetDisplayName(placement.name)
    mesh.GetPrim().SetCustomData(placement.extras)
    faces = asset.mesh.faces.int()
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices.numpy()))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.flatten().numpy()))
    counts = torch.full_like(faces[:, 0], 3)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts.numpy()))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.numpy()))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateExtentAttr(UsdGeom.Mesh.ComputeExtent(mesh.GetPointsAttr().Get()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    coordinates = Sdf.ValueTypeNames.TexCoord2fArray
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", coordinates, UsdGeom.Tokens.vertex)
    primvar.Set(Vt.Vec2fArray.FromNumpy(uv.numpy()))
    return mesh.GetPrim()


def _bind_material(stage: Any, surface: Any) -> None:  # noqa: ANN401 - of a package without types
    """Bind a matte material with the textures ``albedo.png`` and ``normal.png``."""
    from pxr import Gf, Sdf, UsdShade

    kind = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, "/asset/material")
    shader = UsdShade.Shader.Define(stage, "/asset/material/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("roughness", kind.Float).Set(1.0)
    reader = UsdShade.Shader.Define(stage, "/asset/material/uv")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", kind.String).Set("st")
    where = reader.CreateOutput("result", kind.Float2)
    for name, slot, space, scale, bias in (
        ("albedo", "diffuseColor", "sRGB", 1.0, 0.0),
        ("normal", "normal", "raw", 2.0, -1.0),
    ):
        texture = UsdShade.Shader.Define(stage, f"/asset/material/{name}")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", kind.Asset).Set(f"./{name}.png")
        texture.CreateInput("sourceColorSpace", kind.Token).Set(space)
        texture.CreateInput("scale", kind.Float4).Set(Gf.Vec4f(scale, scale, scale, 1.0))
        texture.CreateInput("bias", kind.Float4).Set(Gf.Vec4f(bias, bias, bias, 0.0))
        for side in ("wrapS", "wrapT"):
            texture.CreateInput(side, kind.Token).Set("clamp")
        texture.CreateInput("st", kind.Float2).ConnectToSource(where)
        colors = texture.CreateOutput("rgb", kind.Float3)
        type_ = kind.Normal3f if slot == "normal" else kind.Color3f
        shader.CreateInput(slot, type_).ConnectToSource(colors)
    shader_out = shader.CreateOutput("surface", kind.Token)
    material.CreateSurfaceOutput().ConnectToSource(shader_out)
    UsdShade.MaterialBindingAPI.Apply(surface).Bind(material)
