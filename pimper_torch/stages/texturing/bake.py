"""Textures of a simplified mesh, sampled from the surface that it approximates."""

import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from pimper_torch.geometry import surfaces
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.surfaces import carried_normals
from pimper_torch.geometry.tangents import frames, vertex_tangents
from pimper_torch.geometry.visibility import Hits, RayCaster, ray_caster
from pimper_torch.radiometry import to_bytes
from pimper_torch.radiometry.base_color import albedo_scale, base_color
from pimper_torch.records import Mesh, Relighting, TexturedMesh
from pimper_torch.records.shapes import Mask, Scalar, Vertices
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.stage import Stage
from pimper_torch.stages.texturing.atlas import Atlas, unwrapped
from pimper_torch.stages.texturing.inpaint import INPAINTED, inpainted

# Texels along a median side of the surface's faces.
_TEXELS_PER_SIDE = 1.5


class Texture(Stage):
    """Bake a surface and its materials onto a simplified mesh, see :func:`textured`."""

    kept_as = TexturedMesh

    def forward(self, full: Mesh, few: Mesh, relighting: Relighting) -> TexturedMesh:
        """Bake the textures.

        Args:
            few: The simplified mesh, whose vertices have the materials.
        """
        return textured(full, few, relighting.materials.at_vertices())


def textured(
    full: Mesh, few: Mesh, reflectance: Vertices | None = None, atlas: Atlas | None = None
) -> TexturedMesh:
    """Bake albedo and normals of a surface into textures of a simplified mesh.

    Implausibly bright albedo is inpainted first.

    From the centre of every texel, a ray along the mesh's interpolated normals is cast outward and
    inward, and the nearer intersection is used. A texel far from all faces, or without a hit on
    surface of similar orientation, has the values of the nearest texel with one.

    Args:
        full: The surface, on the CPU.
        few: The simplified mesh; the normal map is relative to its normals.
        reflectance: Metallic, roughness and specular of its vertices; ``None`` for matte.
        atlas: Of ``few``; made by xatlas by default.
    """
    caster = ray_caster(full)
    full, few = (mesh.detach().to(torch.float32) for mesh in (full, few))
    if atlas is None:
        side = float(surfaces.side_lengths(full.vertices_world[full.faces]).median())
        atlas = unwrapped(few, side / _TEXELS_PER_SIDE)
    (full, uncertainty), texel_faces = inpainted(full), _texel_faces(atlas)
    normals = carried_normals(few)[atlas.vertex]
    mesh = few.take(atlas.vertex).replace(faces=atlas.faces)
    shape = surfaces.vertex_normals(few.vertices_world, few.faces)[atlas.vertex]
    tangent = vertex_tangents(mesh.vertices_world, normals, atlas.uv, mesh.faces)
    colors = base_color(full, albedo_scale(few)).expand(-1, 3)
    values = torch.cat([carried_normals(full), colors, uncertainty[:, None]], dim=1)
    face_normals = surfaces.unit_face_normals(full.vertices_world, full.faces)
    # The simplified mesh is off by far less than its sides; a surface farther away is unrelated.
    reach = surfaces.side_lengths(few.vertices_world[few.faces]).median()
    carried = mesh.vertices_world[:, :0] if reflectance is None else reflectance[atlas.vertex]

    def bake(texels: Int[Tensor, " texel"]) -> tuple[Tensor, Tensor]:
        """Return the values of texels, and whether rays hit the surface."""
        hits = texel_faces.take(texels)
        at, outward = (hits.interpolate(one, mesh.faces) for one in (mesh.vertices_world, shape))
        met = _nearest_hits(caster, at, outward, face_normals, reach)
        rows = met.interpolate(values, full.faces)
        axes = frames(hits, normals, tangent, mesh.faces)
        columns = [_relative(rows[:, :3], axes), rows[:, 3:], hits.interpolate(carried, mesh.faces)]
        return torch.cat(columns, dim=1), met.face >= 0

    (texels,) = torch.nonzero(texel_faces.face >= 0, as_tuple=True)
    blocks = side_by_side(bake, torch.split(texels, 250_000), tracked=False)
    baked, met = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    raster = _filled_raster(baked, met, texels, atlas)
    return TexturedMesh(
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


def _nearest_hits(
    caster: RayCaster,
    points: Vertices,
    outward: Vertices,
    face_normals: Float[Tensor, "face 3"],
    reach: Scalar,
) -> Hits:
    """Return the nearer hits of rays outward and inward on surface of similar orientation."""

    def along(direction: Vertices) -> Hits:
        met = caster.cast(points, direction, reach)
        similar = (face_normals[met.face] * outward).sum(dim=1) > 0
        distance = met.distance.where(similar, torch.inf)
        return met.replace(face=met.face.where(similar, -1), distance=distance)

    ahead, behind = along(outward), along(-outward)
    return ahead.where(ahead.distance <= behind.distance, behind)


def _filled_raster(
    baked: Float[Tensor, "texel channel"],
    met: Bool[Tensor, " texel"],
    texels: Int[Tensor, " texel"],
    atlas: Atlas,
) -> Float[Tensor, "height width channel"]:
    """Return the values of all texels; where rays missed, those of the nearest texel with a hit."""
    size = (atlas.height, atlas.width)
    raster = baked.new_zeros(atlas.height * atlas.width, baked.shape[1])
    raster[texels] = baked
    measured = torch.zeros(len(raster), dtype=torch.bool)
    measured[texels] = met
    raster = raster[_nearest(measured.reshape(size))[0]]
    raster[texels[~met], 6] = INPAINTED
    return raster.reshape(*size, -1)


def halved(asset: TexturedMesh) -> TexturedMesh:
    """Return the asset with textures of half the size."""

    def half(texture: Float[Tensor, "height width channel"]) -> Tensor:
        return avg_pool2d(texture.movedim(-1, 0), 2).movedim(0, -1)

    reflectance = asset.reflectance
    return asset.replace(
        base_color=half(asset.base_color.float()).round().to(torch.uint8),
        normal=half(asset.normal.float()).round().to(torch.uint8),
        uncertainty=half(asset.uncertainty[..., None].float())[..., 0].round().to(torch.uint8),
        reflectance=None if reflectance is None else half(reflectance),
    )


def _texel_faces(atlas: Atlas) -> Hits:
    """Return the face of every texel, row by row, and the position on it; face -1 far from all.

    GPUs interpolate a texel at a border with one outside the chart, which therefore has the
    border's face, extrapolated.
    """
    size = atlas.uv.new_tensor([atlas.width, atlas.height])
    flat = torch.cat([atlas.uv * size, torch.zeros_like(atlas.uv[:, :1])], dim=1)
    centers = pixel_centers(atlas.width, atlas.height, like=flat).reshape(-1, 2)
    start = torch.cat([centers, torch.full_like(centers[:, :1], -1.0)], dim=1)
    met = RayCaster(flat, atlas.faces).cast(start, torch.tensor([0.0, 0, 1]).expand_as(start))
    nearest, distance = _nearest((met.face >= 0).reshape(atlas.height, atlas.width))
    # Interpolation uses texels up to a diagonal away.
    (adjacent,) = torch.nonzero((distance > 0) & (distance < 1.5), as_tuple=True)
    face, barycentric = met.face.clone(), met.barycentric.clone()
    face[adjacent] = met.face[nearest[adjacent]]
    barycentric[adjacent] = surfaces.barycentric_2d(
        centers[adjacent], flat[atlas.faces[face[adjacent]], :2]
    )
    # Slivers would be extrapolated far.
    close = (barycentric > -1.0).all(dim=1)
    return met.replace(face=torch.where(close, face, -1), barycentric=barycentric)


def _relative(
    normals: Float[Tensor, "texel 3"], axes: Float[Tensor, "texel 3 3"]
) -> Float[Tensor, "texel 3"]:
    """Return unit vectors along the normals, in coordinates of the axes."""
    tangent, bitangent, normal = axes.unbind(dim=-1)
    # Cramer's rule: the axes are not exactly perpendicular, and rarely degenerate.
    across = [torch.linalg.cross(*pair) for pair in ((bitangent, normal), (normal, tangent))]
    across.append(torch.linalg.cross(tangent, bitangent))
    volume = (tangent * across[0]).sum(dim=1, keepdim=True)
    relative = torch.stack([(normals * axis).sum(dim=1) for axis in across], dim=1) * volume.sign()
    relative = normalize(relative, dim=1)
    # Viewers do not draw a surface that faces away from its own normal.
    return normalize(torch.cat([relative[:, :2], relative[:, 2:].clamp_min(0.02)], dim=1), dim=1)


def _nearest(known: Mask) -> tuple[Int[Tensor, " texel"], Float[Tensor, " texel"]]:
    """Return the index of the nearest true texel for every texel, row by row, and its distance."""
    distance, (row, column) = distance_transform_edt(~known.numpy(), return_indices=True)
    index = torch.from_numpy(row).long() * known.shape[1] + torch.from_numpy(column)
    return index.flatten(), torch.from_numpy(distance).flatten()
