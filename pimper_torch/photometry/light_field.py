"""Light that varies over the scene: a point light and spherical harmonics in every view."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.photometry.harmonics import linearized
from pimper_torch.records import Record

# Minimum cosine between normal and direction of the point light for a sample to count as lit: a
# choice, 3 degrees from grazing, as coarse normals are off by a few degrees.
_MIN_COSINE = 0.05

# Minimum fraction of the shading that is soft light's for a patch in shadow to be used: a choice.
_MIN_SOFT = 0.25


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LightField(Record):
    r"""The light at every point of the scene, in every view.

    A surface at ``x`` with normal ``n`` and albedo 1 shows

    .. math:: s \cdot h(n) + \max(0, E(x) \cdot n), \qquad
              E(x) = |e| \frac{e/|e| - c (x - o)}{|e/|e| - c (x - o)|^3}:

    soft light ``s`` (harmonics ``h`` to second order), and a point light in direction ``e`` at
    distance ``1 / c`` from the origin ``o``, whose irradiance there is ``|e|`` and falls off with
    the square of the distance.

    Attributes:
        soft: Harmonics ``(1, n)`` and those of second order, world.
        point_light: ``e``; zero for none.
        closeness: ``c``, the inverse distance; zero for a distant light.
        origin: World.
        gain: Of all light: colour times exposure. Radiance over it is gray, and of like strength in
            all views. 1 if ``None``.
        exposure: Factor of the lights here that makes them those of the photographs.
    """

    soft: Float[Tensor, "view 9"]
    point_light: Float[Tensor, "view 3"]
    closeness: Float[Tensor, " view"]
    origin: Float[Tensor, " 3"]
    gain: Float[Tensor, "view channel"] | None = None
    exposure: Float[Tensor, " view"] | None = None

    def point_light_at(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point view 3"]:
        """Return ``E``, the direction to the point light times its irradiance."""
        strength = self.point_light.norm(dim=1)
        direction = self.point_light / torch.where(strength > 0, strength, 1)[:, None]
        away = direction - self.closeness[:, None] * (points - self.origin)[:, None]
        distance = away.norm(dim=-1, keepdim=True)
        return strength[:, None] * away / torch.where(strength[:, None] > 0, distance, 1) ** 3

    def soft_at(self, normals: Float[Tensor, "point 3"]) -> Float[Tensor, "point view 4"]:
        """Return first-order light that is soft light near given normals; world frame."""
        return linearized(self.soft, normals)

    def lights_at(
        self, points: Float[Tensor, "point 3"], normals: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point view 4"]:
        """Return first-order light near normals that face the point light; world frame."""
        point_light, soft = self.point_light_at(points), self.soft_at(normals)
        return torch.cat([soft[..., :1], soft[..., 1:] + point_light], dim=-1)


def is_strong(
    soft: Float[Tensor, "patch view 4"], point_light: Float[Tensor, "patch view 3"]
) -> Bool[Tensor, "patch view"]:
    """Find where directed soft light shades patches by much beside a point light."""
    directed, strength = (soft[..., 1:] != 0).any(dim=-1), point_light.norm(dim=-1)
    return directed & (strength > 0) & (soft[..., 0] - soft[..., 3] > _MIN_SOFT * strength)


def faces_light(
    point_light: Float[Tensor, "patch view 3"], normals: Float[Tensor, "patch sample 3"]
) -> Bool[Tensor, "patch view sample"]:
    """Find where the surface faces the point light; true everywhere in a view without one.

    Elsewhere it is in attached shadow, where shading is not linear in ``(1, n)``.
    """
    return point_light @ normals.mT >= _MIN_COSINE * point_light.norm(dim=2, keepdim=True)
