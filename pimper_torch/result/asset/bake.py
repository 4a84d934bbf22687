"""Textures of a mesh of few faces, read off the surface that it approximates."""

import torch
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from pimper_torch.ground.geometry import surfaces
from pimper_torch.ground.geometry.pixels import pixel_centers
from pimper_torch.ground.geometry.visibility import Hits, RayCaster
from pimper_torch.ground.radiometry import to_bytes
from pimper_torch.ground.shapes import Mask, Vertices
from pimper_torch.records import Mesh, Relighting, Textured
from pimper_torch.result.asset.atlas import Atlas, unwrapped
from pimper_torch.result.asset.inpaint import INPAINTED, inpainted
from pimper_torch.result.asset.tangents import frames, tangents
from pimper_torch.result.viz.maps import albedo_scale, base_color, carried_normals
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.runtime.stage import Stage

# Texels along a median side of the surface's faces.
_TEXELS_PER_SIDE = 1.5


class Texture(Stage):
    """Bake a surface and its materials onto few faces, see :func:`textured`."""

    def forward(self, full: Mesh, few: Mesh, relighting: Relighting) -> Textured:
        """Bake it.

        Args:
            few: The mesh whose vertices have the materials.
        """
        return textured(full, few, relighting.materials.at_vertices())


def textured(
    full: Mesh, few: Mesh, reflectance: Vertices | None = None, atlas: Atlas | None = None
) -> Textured:
    """Read albedo and normals of a surface off onto textures of a mesh that has fewer faces.

    Albedo that is implausibly bright is inpainted before.

    From the centre of every texel, on a face of the mesh, a ray along the mesh's blended normals
    meets the surface, outward or inward, where that is nearer. A texel far from all faces, or whose
    ray meets no surface that faces the same way, has the values of the nearest one that does.

    Args:
        full: The surface, on the CPU.
        few: The same of fewer faces, its normals those that the normal map is relative to.
        reflectance: Metallic, roughness and specular of its vertices; matte without.
        atlas: Of ``few``; laid out by xatlas unless given.
    """
    full, few = (one.detach().to(torch.float32) for one in (full, few))
    if atlas is None:
        side = float(surfaces.side_lengths(full.vertices_world[full.faces]).median())
        atlas = unwrapped(few, side / _TEXELS_PER_SIDE)
    full, uncertainty = inpainted(full)
    normals = carried_normals(few)[atlas.vertex]
    mesh = few.take(atlas.vertex).replace(faces=atlas.faces)
    shape = surfaces.vertex_normals(few.vertices_world, few.faces)[atlas.vertex]
    tangent = tangents(mesh.vertices_world, normals, atlas.uv, mesh.faces)
    colors = base_color(full, albedo_scale(few)).expand(-1, 3)
    values = torch.cat([carried_normals(full), colors, uncertainty[:, None]], dim=1)
    caster, laid = RayCaster(full.vertices_world, full.faces), _laid(atlas)
    upright = surfaces.unit_face_normals(full.vertices_world, full.faces)
    # Few faces are off by far less than their sides; a surface farther away is elsewhere.
    reach = surfaces.side_lengths(few.vertices_world[few.faces]).median()
    own = mesh.vertices_world[:, :0] if reflectance is None else reflectance[atlas.vertex]

    def bake(texels: Int[Tensor, " texel"]) -> tuple[Tensor, Tensor]:
        """Return the values of texels, and whether the surface was met."""
        here = laid.take(texels)
        points = here.interpolate(mesh.vertices_world, mesh.faces)
        outward = here.interpolate(shape, mesh.faces)
        # Rays outward, then those inward.
        met = caster.cast(points.repeat(2, 1), torch.cat([outward, -outward]), reach)
        same_side = (upright[met.face] * outward.repeat(2, 1)).sum(dim=1) > 0
        met = met.replace(face=met.face.where(same_side, -1))
        distances = met.distance.where(same_side, torch.inf).chunk(2)
        row = torch.arange(len(points))
        met = met.take(torch.where(distances[0] <= distances[1], row, row + len(points)))
        found = met.interpolate(values, full.faces)
        axes = frames(here, normals, tangent, mesh.faces)
        columns = [_relative(found[:, :3], axes), found[:, 3:], here.interpolate(own, mesh.faces)]
        return torch.cat(columns, dim=1), met.face >= 0

    (texels,) = torch.nonzero(laid.face >= 0, as_tuple=True)
    blocks = side_by_side(bake, torch.split(texels, 250_000), tracked=False)
    found, met = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    raster = found.new_zeros(len(laid.face), found.shape[1])
    raster[texels] = found
    known = torch.zeros_like(laid.face, dtype=torch.bool)
    known[texels] = met
    size = (atlas.height, atlas.width)
    raster = raster[_nearest_known(known.reshape(size))[0]]
    raster[(laid.face >= 0) & ~known, 6] = INPAINTED
    raster = raster.reshape(*size, -1)
    return Textured(
        mesh=mesh,
        vertex=atlas.vertex,
        normals=normals,
        uv=atlas.uv,
        tangent=tangent,
        normal=(255 * (0.5 + 0.5 * raster[..., :3])).round().to(torch.uint8),
        base_color=to_bytes(raster[..., 3:6]),
        uncertainty=(255 * raster[..., 6]).round().to(torch.uint8),
        reflectance=None if reflectance is None else raster[..., 7:],
        charts=atlas.charts,
    )


def halved(asset: Textured) -> Textured:
    """Return the same with textures of half the size."""

    def half(texture: Float[Tensor, "height width channel"]) -> Tensor:
        return avg_pool2d(texture.movedim(-1, 0), 2).movedim(0, -1)

    reflectance = asset.reflectance
    return asset.replace(
        base_color=half(asset.base_color.float()).round().to(torch.uint8),
        normal=half(asset.normal.float()).round().to(torch.uint8),
        uncertainty=half(asset.uncertainty[..., None].float())[..., 0].round().to(torch.uint8),
        reflectance=None if reflectance is None else half(reflectance),
    )


def _laid(atlas: Atlas) -> Hits:
    """Find the face that every texel shows, row by row, and where on it; -1 where none is near.

    Graphics cards blend a texel at a border with one off the chart: that shows the border's face
    continued.
    """
    size = atlas.uv.new_tensor([atlas.width, atlas.height])
    flat = torch.cat([atlas.uv * size, torch.zeros_like(atlas.uv[:, :1])], dim=1)
    centers = pixel_centers(atlas.width, atlas.height, like=flat).reshape(-1, 2)
    start = torch.cat([centers, torch.full_like(centers[:, :1], -1.0)], dim=1)
    met = RayCaster(flat, atlas.faces).cast(start, torch.tensor([0.0, 0, 1]).expand_as(start))
    nearest, distance = _nearest_known((met.face >= 0).reshape(atlas.height, atlas.width))
    # Texels that blending may reach are a diagonal away.
    (beside,) = torch.nonzero((distance > 0) & (distance < 1.5), as_tuple=True)
    face, barycentric = met.face.clone(), met.barycentric.clone()
    face[beside] = met.face[nearest[beside]]
    barycentric[beside] = surfaces.barycentric_2d(
        centers[beside], flat[atlas.faces[face[beside]], :2]
    )
    # Slivers would be continued far.
    close = (barycentric > -1.0).all(dim=1)
    return met.replace(face=torch.where(close, face, -1), barycentric=barycentric)


def _relative(
    normals: Float[Tensor, "texel 3"], axes: Float[Tensor, "texel 3 3"]
) -> Float[Tensor, "texel 3"]:
    """Return the unit vectors that the axes turn into the normals' directions."""
    tangent, bitangent, normal = axes.unbind(dim=-1)
    # Cramer's rule: the axes are not quite at right angles, and seldom without volume.
    across = [torch.linalg.cross(*pair) for pair in ((bitangent, normal), (normal, tangent))]
    across.append(torch.linalg.cross(tangent, bitangent))
    volume = (tangent * across[0]).sum(dim=1, keepdim=True)
    found = torch.stack([(normals * one).sum(dim=1) for one in across], dim=1) * volume.sign()
    found = normalize(found, dim=1)
    # Viewers do not draw a surface that faces away from itself.
    return normalize(torch.cat([found[:, :2], found[:, 2:].clamp_min(0.02)], dim=1), dim=1)


def _nearest_known(known: Mask) -> tuple[Int[Tensor, " texel"], Float[Tensor, " texel"]]:
    """Number the nearest known texel of every one, row by row, and return how far that is."""
    away, (row, column) = distance_transform_edt(~known.numpy(), return_indices=True)
    index = torch.from_numpy(row).long() * known.shape[1] + torch.from_numpy(column)
    return index.flatten(), torch.from_numpy(away).flatten()
