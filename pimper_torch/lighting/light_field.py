r"""Light that varies over the scene: a point light and spherical harmonics in every view.

Under distant light of any distribution the radiance of a convex Lambertian surface is, to first
order, :math:`x = \rho\, l^\top (1, n)`, with albedo, four coefficients of the light, and normal.
``l`` includes the constants of the real harmonics. Second order adds five coefficients, and has
99 % of the energy instead of 88 %.

Source: Basri & Jacobs, PAMI 25(2), 2003; Ramamoorthi & Hanrahan, JOSA A 18(10), 2001.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.records import Record
from pimper_torch.records.shapes import Points, Vectors


def harmonics(normals: Vectors) -> Float[Tensor, "*batch 4"]:
    """Return ``(1, n)``, the basis in which shading is linear in the light.

    >>> harmonics(torch.tensor([0.0, 0.0, -1.0]))
    tensor([ 1.,  0.,  0., -1.])
    """
    return torch.cat([torch.ones_like(normals[..., :1]), normals], dim=-1)


def second_harmonics(normals: Vectors) -> Float[Tensor, "*batch 5"]:
    """Return the second-order harmonics ``(xy, yz, xz, x^2 - y^2, 3 z^2 - 1)``."""
    x, y, z = normals.unbind(dim=-1)
    return torch.stack([x * y, y * z, x * z, x**2 - y**2, 3 * z**2 - 1], dim=-1)


def linearized(lights: Float[Tensor, "view 9"], normals: Points) -> Float[Tensor, "point view 4"]:
    r"""Return first-order lights with the same shading as second-order ones near given normals.

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
    """Return lights rotated to the target frame; ``l_0`` and shading ``l . (1, n)`` are kept."""
    rotated = lights[..., 1:] @ target_from_source[..., :3, :3].mT
    return torch.cat([lights[..., :1].expand_as(rotated[..., :1]), rotated], dim=-1)


# Minimum cosine between normal and direction of the point light for a sample to count as lit: a
# choice, 3 degrees from grazing, as coarse normals are off by a few degrees.
_MIN_COSINE = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LightField(Record):
    r"""The light at every point of the scene, in every view.

    The radiance of a surface at ``x`` with normal ``n`` and albedo 1 is

    .. math:: s \cdot h(n) + \max(0, E(x) \cdot n), \qquad
              E(x) = |e| \frac{e/|e| - c (x - o)}{|e/|e| - c (x - o)|^3}:

    with soft light ``s`` (harmonics ``h`` to second order) and a point light in direction ``e``, at
    distance ``1 / c`` from the origin ``o``. Its irradiance is ``|e|`` at the origin, and falls off
    with the square of the distance.

    Attributes:
        soft: ``s``: harmonics ``(1, n)`` and those of second order, world.
        point_light: ``e``, world; zero for none.
        inverse_distance: ``c``; zero for a distant light.
        origin: ``o``, world.
        gain: Colour times exposure of all light. Radiance over it is gray and of similar strength
            in all views. 1 if ``None``.
        exposure: Factor from the lights of this record to those of the photographs.
    """

    soft: Float[Tensor, "view 9"]
    point_light: Float[Tensor, "view 3"]
    inverse_distance: Float[Tensor, " view"]
    origin: Float[Tensor, " 3"]
    gain: Float[Tensor, "view channel"] | None = None
    exposure: Float[Tensor, " view"] | None = None

    def point_light_at(self, points: Points) -> Float[Tensor, "point view 3"]:
        """Return ``E``, the direction to the point light times its irradiance; world."""
        strength = self.point_light.norm(dim=1)
        direction = self.point_light / torch.where(strength > 0, strength, 1)[:, None]
        away = direction - self.inverse_distance[:, None] * (points - self.origin)[:, None]
        distance = away.norm(dim=-1, keepdim=True)
        return strength[:, None] * away / torch.where(strength[:, None] > 0, distance, 1) ** 3

    def lights_at(self, points: Points, normals: Points) -> Float[Tensor, "point view 4"]:
        """Return first-order light near normals that face the point light; world."""
        point_light, soft = self.point_light_at(points), linearized(self.soft, normals)
        return torch.cat([soft[..., :1], soft[..., 1:] + point_light], dim=-1)


def faces_light(
    point_light: Float[Tensor, "patch view 3"], normals: Float[Tensor, "patch sample 3"]
) -> Bool[Tensor, "patch view sample"]:
    """Return whether samples face the point light; true in views without one.

    Other samples are in attached shadow, where shading is not linear in ``(1, n)``.
    """
    return point_light @ normals.mT >= _MIN_COSINE * point_light.norm(dim=2, keepdim=True)
