"""Objects of a rendered scene, and how much light their materials send to the eye.

Radiance is counted so that a white matte surface facing a light of irradiance 1 has
radiance 1: physics' irradiance divided by pi. A highlight is then pi times the usual
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

from pimper_torch.ground.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.ground.geometry.surfaces import vertex_normals
from pimper_torch.records import Mesh
from pimper_torch.result.relighting.lit_surface import facet_density, masking
from pimper_torch.runtime.config import require


def fresnel(
    cosine: Float[Tensor, "*batch"], specular: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Return the fraction of light that is mirrored.

    Args:
        cosine: Between the light and what it falls on.
        specular: The share at a cosine of 1; 0 mirrors nothing at any angle.
    """
    # No real dielectric mirrors less than 2 % head on; less stands for something partly matte.
    grazing = (specular / 0.02).clamp_max(1)
    return specular + (grazing - specular) * (1 - cosine).clamp(0, 1) ** 5


def reflect(
    normals: Float[Tensor, "*batch 3"],
    to_light: Float[Tensor, "*batch 3"],
    to_eye: Float[Tensor, "*batch 3"],
    specular: Float[Tensor, "*batch"],
    roughness: Float[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Split light of irradiance 1 into the radiance of a white matte part and of the highlight.

    The matte part lies under the glaze: it receives and sends only light that is not mirrored. Both
    are 0 where the light is below the horizon.

    Args:
        normals: Unit, as the directions to light and eye.
        specular: Fraction mirrored head on.
        roughness: Its square is GGX's alpha.
    """
    cosine = (normals * to_light).sum(dim=-1)
    above = cosine > 0
    cosine = cosine.clamp_min(0)
    seen = (normals * to_eye).sum(dim=-1).clamp_min(1e-3)
    half = normalize(to_light + to_eye, dim=-1)
    mirrored = fresnel((half * to_light).sum(dim=-1), specular)
    alpha = roughness**2
    passed = (1 - fresnel(cosine, specular)) * (1 - fresnel(seen, specular))
    density = facet_density((normals * half).sum(dim=-1).clamp(0, 1), alpha)
    lobe = torch.pi * mirrored * density * masking(cosine.clamp_min(1e-6), seen, alpha) * cosine
    return torch.where(above, cosine * passed, 0), torch.where(above, lobe, 0)


Texture = Callable[[Float[Tensor, "*batch 3"]], Float[Tensor, "*batch channel"]]


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneObject:
    """A mesh and its material.

    Attributes:
        mesh: World, with normals, or those of the faces averaged at each vertex.
        texture: Albedo at points of the world; ``None`` takes the mesh's own albedo.
        specular: Fraction of light that the surface mirrors head on: 0 is matte, 0.04 is glaze.
        roughness: Of the mirroring facets (its square is GGX's alpha): 0.1 is polished, 0.5 satin.
        surroundings: True for objects around the reconstructed one, such as the table.
    """

    mesh: Mesh
    texture: Texture | None = None
    specular: float = 0.0
    roughness: float = 0.4
    surroundings: bool = False

    def __post_init__(self) -> None:
        """Refuse what no material is."""
        require(0 <= self.specular <= 1, "specular", self.specular, "between 0 and 1")
        # Below, a point light's highlight is a spark that no pixel sees.
        require(0.03 <= self.roughness <= 1, "roughness", self.roughness, "between 0.03 and 1")
        require(
            self.texture is not None or self.mesh.albedo is not None,
            "texture",
            self.texture,
            "a texture, or a mesh with an albedo of its own",
        )


def transferred(item: SceneObject, world_from_own: Float[Tensor, "4 4"]) -> SceneObject:
    """Move an object from its own frame into the world, with its texture."""
    normals, texture = item.mesh.normals_world, item.texture
    mesh = item.mesh.replace(
        vertices_world=transform(world_from_own, item.mesh.vertices_world),
        normals_world=None if normals is None else rotate(world_from_own, normals),
    )
    if texture is None:
        return replace(item, mesh=mesh)
    own_from_world, own = invert_rigid(world_from_own), texture

    def moved(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch channel"]:
        return own(transform(own_from_world.to(points), points))

    return replace(item, mesh=mesh, texture=moved)


def normals_at_vertices(item: SceneObject) -> Float[Tensor, "vertex 3"]:
    """Return the normals of an object's mesh, its own or averaged from its faces; float32."""
    if item.mesh.normals_world is not None:
        return item.mesh.normals_world.float()
    return vertex_normals(item.mesh.vertices_world, item.mesh.faces).float()


def albedo_at_vertices(item: SceneObject) -> Float[Tensor, "vertex channel"]:
    """Evaluate an object's texture, in colour, at its vertices; float32."""
    if item.texture is not None:
        return item.texture(item.mesh.vertices_world.float()).expand(-1, 3)
    assert item.mesh.albedo is not None
    return item.mesh.albedo.float().expand(-1, 3)
