"""The light of each photograph of a rendered scene."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PointLight(Record):
    """The light of one photograph, in float32; see :class:`Lights`."""

    position: Float[Tensor, " 3"]
    target: Float[Tensor, " 3"]
    irradiance: float
    ambient: float
    window: Float[Tensor, " 3"] | None = None
    colour: Float[Tensor, " 3"] | None = None

    def from_window(self, normals: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"] | float:
        """Return the irradiance of the window's soft light, for normals; see :class:`Lights`."""
        if self.window is None:
            return 0.0
        strength = self.window.norm()
        return (strength + normals @ self.window) ** 2 / (4 * strength)

    def harmonics(self) -> Float[Tensor, " 4"]:
        """Return the first-order light at the target; see :meth:`Lights.harmonics_world`."""
        alone = Lights(
            positions_world=self.position[None],
            irradiance=self.position.new_tensor([self.irradiance]),
            ambient=self.position.new_tensor([self.ambient]),
            target_world=self.target,
            window=self.window,
        )
        return alone.harmonics_world()[0]

    def arriving(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
        """Return the direction to the light, and the irradiance perpendicular to it, at points."""
        toward = self.position - points
        distance = toward.norm(dim=-1)
        falloff = ((self.position - self.target).norm() / distance) ** 2
        return toward / distance[..., None], self.irradiance * falloff


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Lights(Record):
    """A point light and a uniform ambient light for each view.

    A point of albedo 1 facing the point light at ``target_world`` has radiance
    ``irradiance + ambient``; elsewhere the former decreases with the square of the distance.

    Attributes:
        ambient: Radiance of a white point in shadow.
        window: Direction to a soft light's centre times the irradiance ``w`` of surfaces facing it;
            a surface rotated by ``a`` gets ``w (1 + cos a)**2 / 4``, without cast shadows.
    """

    positions_world: Float[Tensor, "view 3"]
    irradiance: Float[Tensor, " view"]
    ambient: Float[Tensor, " view"]
    target_world: Float[Tensor, " 3"]
    window: Float[Tensor, " 3"] | None = None
    colour: Float[Tensor, "view 3"] | None = None

    def point_light(self, view: int) -> PointLight:
        """Return the light of one photograph."""
        return PointLight(
            position=self.positions_world[view].float(),
            target=self.target_world.float(),
            irradiance=float(self.irradiance[view]),
            ambient=float(self.ambient[view]),
            window=None if self.window is None else self.window.float(),
            colour=None if self.colour is None else self.colour[view].float(),
        )

    def harmonics_world(self) -> Float[Tensor, "view 4"]:
        """Return the first-order light ``l`` at the target: radiance is albedo * l . (1, n)."""
        toward = normalize(self.positions_world - self.target_world, dim=-1)
        directed = self.irradiance[:, None] * toward
        ambient = self.ambient
        if self.window is not None:  # the quadratic part's mean over directions is a third
            ambient = ambient + self.window.norm() / 3
            directed = directed + self.window / 2
        return torch.cat([ambient[:, None], directed], dim=-1)


def wandering_lights(
    num_views: int,
    generator: torch.Generator,
    *,
    distance: float,
    spread_deg: float = 65.0,
    min_tilt_deg: float = 15.0,
    irradiance: float = 0.8,
    ambient: float = 0.12,
    target: tuple[float, float, float] = (0.0, 0.0, 0.0),
    toward: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Lights:
    """Draw a position of a point light in a cone for every photograph; float64.

    Args:
        distance: From the target, scene units; drawn up to a quarter nearer or farther.
        irradiance: Mean over the views; drawn up to a quarter less or more.
        toward: Axis of the cone, at angles from ``min_tilt_deg`` to ``spread_deg``.
    """
    axis = normalize(torch.tensor(toward, dtype=torch.float64), dim=0)
    aside = torch.linalg.svd(axis[None]).Vh[1:]
    square = _even_square(num_views, generator)
    rotation = 2 * torch.pi * square[:, 0]
    lowest, highest = torch.deg2rad(torch.tensor([spread_deg, min_tilt_deg])).cos().tolist()
    cosine = lowest + (highest - lowest) * square[:, 1]  # uniform over the solid angle
    sine = (1 - cosine**2).sqrt()
    across = rotation.cos()[:, None] * aside[0] + rotation.sin()[:, None] * aside[1]
    direction = cosine[:, None] * axis + sine[:, None] * across
    target_world = torch.tensor(target, dtype=torch.float64)
    return _placed(direction, target_world, generator, distance, irradiance, ambient)


def lights_round(
    azimuths: Float[Tensor, " view"],
    generator: torch.Generator,
    *,
    distance: float,
    target: Float[Tensor, " 3"],
    irradiance: float,
    ambient: float,
    far: bool = False,
) -> Lights:
    """Draw positions of a point light around an object, on the photographed side; float64.

    Args:
        azimuths: Radians about the world's z, counter-clockwise from -y: the centre of the
            point light's range in each photograph.
        distance: From the target, scene units; drawn up to a quarter nearer or farther.
        irradiance: Mean over the views; drawn up to a quarter less or more.
        far: Whether light comes from one direction, without fall-off.
    """
    count = len(azimuths)
    square = _even_square(count, generator)
    rotation = azimuths + torch.deg2rad(160.0 * (square[:, 0] - 0.5))
    lowest, highest = torch.deg2rad(torch.tensor([18.0, 72.0])).sin().tolist()
    sine = lowest + (highest - lowest) * square[:, 1]  # uniform over the solid angle
    cosine = (1 - sine**2).sqrt()
    direction = torch.stack([cosine * rotation.sin(), -cosine * rotation.cos(), sine], dim=-1)
    # At this distance, the fall-off over an object is below single precision.
    farther = 1e5 if far else 1.0
    return _placed(direction, target, generator, distance, irradiance, ambient, farther)


def _placed(
    direction: Float[Tensor, "view 3"],
    target: Float[Tensor, " 3"],
    generator: torch.Generator,
    distance: float,
    irradiance: float,
    ambient: float,
    farther: float = 1.0,
) -> Lights:
    """Draw distances and strengths of point lights, up to a quarter less or more."""
    count = len(direction)
    away = distance * _about_one(count, generator)
    return Lights(
        positions_world=target + farther * away[:, None] * direction,
        irradiance=irradiance * _about_one(count, generator),
        ambient=ambient * _about_one(count, generator),
        target_world=target,
    )


def _about_one(count: int, generator: torch.Generator) -> Float[Tensor, " view"]:
    return 0.75 + 0.5 * torch.rand(count, generator=generator, dtype=torch.float64)


def _even_square(count: int, generator: torch.Generator) -> Float[Tensor, "view 2"]:
    """Distribute points over the unit square.

    The plastic number's sequence fills it evenly for any number of points, so a dozen
    photographs already have lights from all sides (Roberts, 2018).
    """
    steps = torch.arange(count, dtype=torch.float64)[:, None]
    start = torch.rand(2, generator=generator, dtype=torch.float64)
    return torch.remainder(start + steps * start.new_tensor([0.7548776662, 0.5698402910]), 1)
