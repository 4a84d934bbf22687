"""Objects of a rendered scene, and the reflection of their materials.

Radiance is scaled so that a white matte surface facing a light of irradiance 1 has
radiance 1: physical irradiance divided by pi. A highlight is then pi times the usual
bidirectional reflectance, times irradiance and cosine.

Source: Cook & Torrance, ACM TOG 1(1), 1982, for the microfacet model; Schlick, Computer Graphics
Forum 13(3), 1994, for Fresnel's factor.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.records import Mesh
from pimper_torch.runtime.config import require
from pimper_torch.stages.relighting.lit_surface import facet_density, masking


def fresnel(
    cosine: Float[Tensor, "*batch"], specular: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Return the fraction of light that is mirrored.

    Args:
        cosine: Between the light's direction and the normal of the reflecting facet.
        specular: The fraction at a cosine of 1; 0 mirrors nothing at any angle.
    """
    # Real dielectrics mirror at least 2 % at normal incidence; less represents partly matte ones.
    grazing = (specular / 0.02).clamp_max(1)
    return specular + (grazing - specular) * (1 - cosine).clamp(0, 1) ** 5


def reflect(
    normals: Float[Tensor, "*batch 3"],
    to_light: Float[Tensor, "*batch 3"],
    to_eye: Float[Tensor, "*batch 3"],
    specular: Float[Tensor, "*batch"],
    roughness: Float[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Return the radiance of a white matte part and of the highlight, for light of irradiance 1.

    The matte part is below the glaze: it receives and emits only light that is not mirrored. Both
    are 0 where the light is below the horizon.

    Args:
        normals: Unit, like the directions to light and eye.
        specular: Fraction mirrored at normal incidence.
        roughness: Its square is GGX's alpha.
    """
    cosine = (normals * to_light).sum(dim=-1)
    above = cosine > 0
    cosine = cosine.clamp_min(0)
    view = (normals * to_eye).sum(dim=-1).clamp_min(1e-3)
    half = normalize(to_light + to_eye, dim=-1)
    mirrored = fresnel((half * to_light).sum(dim=-1), specular)
    alpha = roughness**2
    passed = (1 - fresnel(cosine, specular)) * (1 - fresnel(view, specular))
    density = facet_density((normals * half).sum(dim=-1).clamp(0, 1), alpha)
    lobe = torch.pi * mirrored * density * masking(cosine.clamp_min(1e-6), view, alpha) * cosine
    return torch.where(above, cosine * passed, 0), torch.where(above, lobe, 0)


Texture = Callable[[Float[Tensor, "*batch 3"]], Float[Tensor, "*batch channel"]]


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneObject:
    """A mesh and its material.

    Attributes:
        mesh: World frame; without normals, area-weighted vertex normals are used.
        texture: Albedo at points of the world; ``None`` for the mesh's albedo.
        specular: Reflectance at normal incidence: 0 is matte, 0.04 is glaze.
        roughness: Of the microfacets (its square is GGX's alpha): 0.1 is polished, 0.5 satin.
        surroundings: True for objects around the reconstructed one, such as the table.
    """

    mesh: Mesh
    texture: Texture | None = None
    specular: float = 0.0
    roughness: float = 0.4
    surroundings: bool = False

    def __post_init__(self) -> None:
        """Refuse values out of range, and an object without albedo."""
        require(0 <= self.specular <= 1, "specular", self.specular, "between 0 and 1")
        # Below, a point light's highlight is smaller than pixels can resolve.
        require(0.03 <= self.roughness <= 1, "roughness", self.roughness, "between 0.03 and 1")
        require(
            self.texture is not None or self.mesh.albedo is not None,
            "texture",
            self.texture,
            "a texture, or a mesh with albedo",
        )


def transferred(item: SceneObject, world_from_local: Float[Tensor, "4 4"]) -> SceneObject:
    """Transform an object with its texture from a local frame to the world."""
    normals, texture = item.mesh.normals_world, item.texture
    mesh = item.mesh.replace(
        vertices_world=transform(world_from_local, item.mesh.vertices_world),
        normals_world=None if normals is None else rotate(world_from_local, normals),
    )
    if texture is None:
        return replace(item, mesh=mesh)
    local_from_world, local = invert_rigid(world_from_local), texture

    def moved(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch channel"]:
        return local(transform(local_from_world.to(points), points))

    return replace(item, mesh=mesh, texture=moved)


def normals_at_vertices(item: SceneObject) -> Float[Tensor, "vertex 3"]:
    """Return the vertex normals of an object's mesh, stored or computed from its faces; float32."""
    if item.mesh.normals_world is not None:
        return item.mesh.normals_world.float()
    return vertex_normals(item.mesh.vertices_world, item.mesh.faces).float()


def albedo_at_vertices(item: SceneObject) -> Float[Tensor, "vertex channel"]:
    """Return the albedo of an object's texture, in three channels, at its vertices; float32."""
    if item.texture is not None:
        return item.texture(item.mesh.vertices_world.float()).expand(-1, 3)
    assert item.mesh.albedo is not None
    return item.mesh.albedo.float().expand(-1, 3)
