r"""Spherical harmonics: shading of a Lambertian surface under distributed light.

Under distant light of any distribution the radiance of a convex Lambertian surface is, to
first order, :math:`x = \rho\, l^\top (1, n)`: albedo, four coefficients of the light, the normal.
The constants of the real harmonics are folded into ``l``. Second order adds five coefficients, and
is 99 % of the energy in place of 88 %.

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


def second_harmonics(normals: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 5"]:
    """Return the harmonics of second order, ``(xy, yz, xz, x^2 - y^2, 3 z^2 - 1)``."""
    x, y, z = normals.unbind(dim=-1)
    return torch.stack([x * y, y * z, x * z, x**2 - y**2, 3 * z**2 - 1], dim=-1)


def linearized(
    lights: Float[Tensor, "view 9"], normals: Float[Tensor, "point 3"]
) -> Float[Tensor, "point view 4"]:
    r"""Return first-order lights that shade as second-order ones do near given normals.

    The harmonics of second order are quadratic forms: :math:`n^\top Q n` is
    :math:`2 (Q n_0)^\top n - n_0^\top Q n_0` up to the square of :math:`n - n_0`.
    """
    xy, yz, xz, difference, along = lights[:, 4:].unbind(dim=1)
    rows = [difference - along, xy / 2, xz / 2, xy / 2, -difference - along, yz / 2]
    forms = torch.stack([*rows, xz / 2, yz / 2, 2 * along], dim=1).reshape(-1, 3, 3)
    slope = 2 * torch.einsum("vij,pj->pvi", forms, normals)
    value = (slope * normals[:, None]).sum(dim=-1, keepdim=True) / 2
    return torch.cat([lights[:, :1] - value, lights[:, 1:4] + slope], dim=-1)


def rotate_lights(
    target_from_source: Float[Tensor, "*#batch 4 4"], lights: Float[Tensor, "*#batch view 4"]
) -> Float[Tensor, "*batch view 4"]:
    """Transform lights to another frame: ``l_0`` stays, the vector part rotates as normals do.

    Shading is the same in every frame: ``l . (1, n)`` with both in the source frame equals
    it with both in the target frame. Only the rotation of the rigid transform matters.
    """
    rotated = lights[..., 1:] @ target_from_source[..., :3, :3].mT
    return torch.cat([lights[..., :1].expand_as(rotated[..., :1]), rotated], dim=-1)
