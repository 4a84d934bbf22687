"""A surface with textures on few faces."""

from jaxtyping import Float
from torch import Tensor

from pimper_torch.asset.atlas import unwrapped
from pimper_torch.asset.bake import Textured, baked
from pimper_torch.geometry.surfaces import side_lengths
from pimper_torch.records import Mesh
from pimper_torch.sfm.surfaces import reduced

# What people can edit, and browsers draw at once.
_FACES = 50_000

# Texels along a median side of the surface's faces.
_TEXELS_PER_SIDE = 1.5


def textured(
    full: Mesh, few: Mesh, reflectance: Float[Tensor, "vertex 3"] | None = None
) -> Textured:
    """Bake a surface onto about 50,000 faces.

    Args:
        full: The surface, on the CPU.
        few: The same of fewer vertices; it is reduced where it has more faces.
        reflectance: Metallic, roughness and specular of the surface's vertices; matte without.
    """
    few = reduced(few, _FACES)
    side = float(side_lengths(full.vertices_world[full.faces]).median())
    return baked(full, few, unwrapped(few, side / _TEXELS_PER_SIDE), reflectance)
