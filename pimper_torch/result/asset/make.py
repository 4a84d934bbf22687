"""A surface with textures on few faces."""

import torch

from pimper_torch.ground.geometry.surfaces import side_lengths
from pimper_torch.ground.shapes import Vertices
from pimper_torch.records import Mesh, Relighting, Textured
from pimper_torch.result.asset.atlas import unwrapped
from pimper_torch.result.asset.bake import baked
from pimper_torch.result.asset.inpaint import inpainted
from pimper_torch.runtime.stage import Stage

# Texels along a median side of the surface's faces.
_TEXELS_PER_SIDE = 1.5


def textured(full: Mesh, few: Mesh, reflectance: Vertices | None = None) -> Textured:
    """Bake a surface onto few faces, without albedo that is too bright to be true.

    Args:
        full: The surface, on the CPU.
        few: The same of fewer faces.
        reflectance: Metallic, roughness and specular of its vertices; matte without.
    """
    full, few = (one.detach().to(torch.float32) for one in (full, few))
    side = float(side_lengths(full.vertices_world[full.faces]).median())
    full, doubt = inpainted(full)
    return baked(full, few, unwrapped(few, side / _TEXELS_PER_SIDE), reflectance, doubt)


class Texture(Stage):
    """Bake a surface and its materials onto few faces, see :func:`textured`."""

    def forward(self, full: Mesh, few: Mesh, relighting: Relighting) -> Textured:
        """Bake it.

        Args:
            few: That the materials are of.
        """
        return textured(full, few, relighting.materials.at_vertices())
