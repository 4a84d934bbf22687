r"""First-order spherical harmonics: shading of a Lambertian surface under distributed light.

Under distant light of any distribution the radiance of a convex Lambertian surface is, to
first order, :math:`x = \rho\, l^\top (1, n)`: albedo, four coefficients of the light, the normal.
The constants of the real harmonics are folded into ``l``.

Source: Basri & Jacobs, PAMI 25(2), 2003; Ramamoorthi & Hanrahan, JOSA A 18(10), 2001.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def harmonics(normals: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Return ``(1, n)``, the basis in which shading is linear in the light.

    >>> harmonics(torch.tensor([0.0, 0.0, -1.0]))
    tensor([ 1.,  0.,  0., -1.])
    """
    return torch.cat([torch.ones_like(normals[..., :1]), normals], dim=-1)


def rotate_lights(
    target_from_source: Float[Tensor, "*#batch 4 4"], lights: Float[Tensor, "*#batch view 4"]
) -> Float[Tensor, "*batch view 4"]:
    """Transform lights to another frame: ``l_0`` stays, the vector part rotates as normals do.

    Shading is the same in every frame: ``l . (1, n)`` with both in the source frame equals
    it with both in the target frame. Only the rotation of the rigid transform matters.
    """
    rotated = lights[..., 1:] @ target_from_source[..., :3, :3].mT
    return torch.cat([lights[..., :1].expand_as(rotated[..., :1]), rotated], dim=-1)
