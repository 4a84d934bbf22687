"""A surface that is seen with its textures."""

from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from pimper_torch.asset.bake import Textured
from pimper_torch.asset.tangents import frames
from pimper_torch.geometry.visibility import Hits
from pimper_torch.radiometry import linear_from_srgb
from pimper_torch.relighting.materials import Materials
from pimper_torch.relighting.surface_pixels import LitSurface


class TexturedSurface(LitSurface):
    """A mesh whose base colours and normals are those of textures, blended between texels."""

    def __init__(self, asset: Textured) -> None:
        super().__init__(asset.mesh.replace(normals_world=asset.normals))
        self.asset = asset

    def appearance(
        self, met: Hits
    ) -> tuple[Float[Tensor, "pixel 3"], Float[Tensor, "pixel channel"]]:
        """Return unit normals, world frame, and base colours where rays meet the mesh."""
        asset, faces = self.asset, self.mesh.faces
        uv = met.interpolate(asset.uv, faces)
        axes = frames(met, asset.normals, asset.tangent, faces)
        relative = 2 * _sampled(asset.normal, uv) - 1
        normals = normalize((axes * relative[:, None]).sum(dim=-1), dim=-1)
        return normals, linear_from_srgb(_sampled(asset.base_color, uv))

    def materials(self, few: Materials) -> Materials:
        """Return the materials of the copied vertices."""
        return few.replace(cluster=few.cluster[self.asset.vertex])


def _sampled(
    texture: UInt8[Tensor, "height width 3"], uv: Float[Tensor, "pixel 2"]
) -> Float[Tensor, "pixel 3"]:
    values = texture.movedim(-1, 0)[None].float() / 255
    grid = (2 * uv - 1)[None, None]
    found = grid_sample(values, grid, padding_mode="border", align_corners=False)
    return found[0, :, 0].mT
