"""What stands in a rendered scene, and what it is made of."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from pimper_torch.config import require
from pimper_torch.evidence.scenes.conductors import Conductor
from pimper_torch.geometry.frames import invert_rigid, rotate, transform
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.records import Mesh

Texture = Callable[[Float[Tensor, "*batch 3"]], Float[Tensor, "*batch channel"]]


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneObject:
    """A mesh and what it is made of.

    Attributes:
        mesh: World. Its normals are interpolated over the faces; without them, those of the
            faces averaged round each vertex.
        texture: Albedo at points of the world; ``None`` takes the mesh's own albedo.
        specular: Fraction of light that the surface mirrors where it comes straight down: 0 is
            wholly matte, 0.04 is glaze or varnish.
        roughness: Of the mirroring facets, as artists count it (its square is GGX's alpha):
            0.1 is polished, 0.5 satin.
        conductor: A metal in place of matte surface under glaze: it mirrors the point lights as
            ``roughness`` says, other objects and the environment sharply. Its albedo is 0.
        surroundings: True for what stands around the reconstructed object, such as the table.
    """

    mesh: Mesh
    texture: Texture | None = None
    specular: float = 0.0
    roughness: float = 0.4
    conductor: Conductor | None = None
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


@dataclass(frozen=True, slots=True, kw_only=True)
class MovedTexture:
    """A texture that moves with its object.

    Attributes:
        texture: In the object's own frame.
        own_from_world: Rigid.
    """

    texture: Texture
    own_from_world: Float[Tensor, "4 4"]

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch channel"]:
        """Return the albedo at points of the world."""
        return self.texture(transform(self.own_from_world.to(points), points))


def transferred(item: SceneObject, world_from_own: Float[Tensor, "4 4"]) -> SceneObject:
    """Move an object from its own frame into the world, with its texture."""
    normals, texture = item.mesh.normals_world, item.texture
    mesh = item.mesh.replace(
        vertices_world=transform(world_from_own, item.mesh.vertices_world),
        normals_world=None if normals is None else rotate(world_from_own, normals),
    )
    if texture is not None:
        texture = MovedTexture(texture=texture, own_from_world=invert_rigid(world_from_own))
    return replace(item, mesh=mesh, texture=texture)


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
