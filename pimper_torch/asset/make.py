"""A surface with textures on few faces."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.asset.atlas import unwrapped
from pimper_torch.asset.bake import Textured, baked
from pimper_torch.geometry.surfaces import side_lengths
from pimper_torch.records import Mesh
from pimper_torch.sfm.colmap_surfaces import reduced

# What people can edit, and browsers draw at once.
_FACES = 50_000

# Texels along a median side of the surface's faces.
_TEXELS_PER_SIDE = 1.5


def few_enough(mesh: Mesh) -> Mesh:
    """Reduce a mesh to about 50,000 faces, where it has more."""
    return reduced(mesh, _FACES)


def textured(
    full: Mesh, few: Mesh, reflectance: Float[Tensor, "vertex 3"] | None = None
) -> Textured:
    """Bake a surface onto few faces.

    Args:
        full: The surface, on the CPU.
        few: The same of fewer faces, see :func:`few_enough`.
        reflectance: Metallic, roughness and specular of its vertices; matte without.
    """
    full, few = (one.detach().to(torch.float32) for one in (full, few))
    side = float(side_lengths(full.vertices_world[full.faces]).median())
    return baked(full, few, unwrapped(few, side / _TEXELS_PER_SIDE), reflectance)
