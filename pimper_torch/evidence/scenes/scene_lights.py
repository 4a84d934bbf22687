"""The light of each photograph of a rendered scene, and its environment."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.evidence.scenes.scene_object import Texture
from pimper_torch.evidence.scenes.textures import random_speckle
from pimper_torch.geometry.directions import even_directions
from pimper_torch.records import Record

_WINDOWS = 6
_WINDOW_RADIANCE = 6.0  # of the brightest wall


@dataclass(frozen=True, slots=True, kw_only=True)
class Environment:
    """An environment map in closed form: patterned walls with bright windows.

    Attributes:
        walls: Radiance in unit directions of its own frame.
        windows: In its own frame; rows of each: the unit direction of its centre, and two
            vectors across it, one over the tangents of half its width and height long.
    """

    walls: Texture
    windows: Float[Tensor, "window 3 3"]
    window_radiance: float
    own_from_world: Float[Tensor, "3 3"]
    scale: float = 1.0

    def __call__(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch channel"]:
        """Return the radiance that arrives from unit directions of the world."""
        own = directions @ self.own_from_world.to(directions).mT
        placed = torch.einsum("wij,...j->...wi", self.windows.to(own), own)
        ahead, across, upward = placed.unbind(dim=-1)
        through = ((across.abs() < ahead) & (upward.abs() < ahead)).any(dim=-1)
        walls = self.walls(own)
        return self.scale * torch.where(through[..., None], self.window_radiance, walls)


def random_environment(generator: torch.Generator) -> Environment:
    """Draw walls and windows; the mean radiance over all directions is 1."""
    walls = random_speckle(
        generator, cells=(0.9, 0.37, 0.15), darkest=0.02, brightest=1.0, contrast=3.0, colour=0.3
    )
    ahead = normalize(torch.randn(_WINDOWS, 3, generator=generator, dtype=torch.float64), dim=-1)
    ahead[:, 2] = ahead[:, 2].abs()  # none in the floor
    across = normalize(torch.linalg.cross(ahead.new_tensor([[0.0, 0, 1]]), ahead), dim=-1)
    upward = torch.linalg.cross(ahead, across)
    half_deg = 4 + 12 * torch.rand(2, _WINDOWS, 1, generator=generator, dtype=torch.float64)
    wide, high = 1 / torch.deg2rad(half_deg).tan()
    drawn = Environment(
        walls=walls,
        windows=torch.stack([ahead, wide * across, high * upward], dim=1),
        window_radiance=_WINDOW_RADIANCE,
        own_from_world=torch.eye(3, dtype=torch.float64),
    )
    return replace(drawn, scale=1 / float(drawn(even_directions(1 << 14)).mean()))


# Farther by this factor, falloff over an object is below what float32 tells.
_FAR = 1e5


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PointLight(Record):
    """The light of one photograph, in float32; see :class:`Lights`."""

    position: Float[Tensor, " 3"]
    target: Float[Tensor, " 3"]
    irradiance: float
    ambient: float
    flash: float
    environment: Environment | None = None
    window: Float[Tensor, " 3"] | None = None
    colour: Float[Tensor, " 3"] | None = None

    def surroundings(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Return the radiance that arrives from where there is no object; 0 without environment."""
        if self.environment is None:
            return torch.zeros_like(directions)
        return self.ambient * self.environment(directions)

    def from_window(self, normals: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"] | float:
        """Return the irradiance of the window's soft light; see :class:`Lights`."""
        if self.window is None:
            return 0.0
        strength = self.window.norm()
        return (strength + normals @ self.window) ** 2 / (4 * strength)

    def arriving(
        self, points: Float[Tensor, "*batch 3"], position: Float[Tensor, " 3"], irradiance: float
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
        """Return the direction to a light, and the irradiance across it, at points."""
        toward = position - points
        distance = toward.norm(dim=-1)
        falloff = ((position - self.target).norm() / distance) ** 2
        return toward / distance[..., None], irradiance * falloff


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Lights(Record):
    """A point light and an even ambient light for each view.

    A point of albedo 1 facing the point light at ``target_world`` has radiance
    ``irradiance + ambient``; elsewhere the former falls off with the square of the distance.

    Attributes:
        ambient: Radiance of a white point in shadow.
        flash: Irradiance at the target of a second light at the camera, without shadows.
        environments: The picture that the ambient light comes from, one a view. Matte surfaces
            get its mean; mirrors and the background show it.
        window: Direction to the middle of soft light times the irradiance ``w`` of what faces it;
            a surface turned by ``a`` gets ``w (1 + cos a)**2 / 4``, without cast shadows.
    """

    positions_world: Float[Tensor, "view 3"]
    irradiance: Float[Tensor, " view"]
    ambient: Float[Tensor, " view"]
    target_world: Float[Tensor, " 3"]
    flash: Float[Tensor, " view"]
    environments: tuple[Environment, ...] | None = None
    window: Float[Tensor, " 3"] | None = None
    colour: Float[Tensor, "view 3"] | None = None

    def point_light(self, view: int) -> PointLight:
        """Pick the light of one photograph."""
        return PointLight(
            position=self.positions_world[view].float(),
            target=self.target_world.float(),
            irradiance=float(self.irradiance[view]),
            ambient=float(self.ambient[view]),
            flash=float(self.flash[view]),
            environment=None if self.environments is None else self.environments[view],
            window=None if self.window is None else self.window.float(),
            colour=None if self.colour is None else self.colour[view].float(),
        )

    def harmonics_world(
        self, eyes_world: Float[Tensor, "view 3"] | None = None
    ) -> Float[Tensor, "view 4"]:
        """Return the first-order light ``l`` at the target: radiance is albedo * l . (1, n).

        Args:
            eyes_world: The cameras' centres, needed for the flash only.
        """
        toward = normalize(self.positions_world - self.target_world, dim=-1)
        directed = self.irradiance[:, None] * toward
        if eyes_world is not None:
            toward_eye = normalize(eyes_world - self.target_world, dim=-1)
            directed = directed + self.flash[:, None] * toward_eye
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
    flash: float = 0.0,
    target: tuple[float, float, float] = (0.0, 0.0, 0.0),
    toward: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Lights:
    """Draw another position of a point light in a cone for every photograph; float64.

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
    return _placed(direction, target_world, generator, distance, (irradiance, ambient, flash))


def lights_round(
    azimuths: Float[Tensor, " view"],
    generator: torch.Generator,
    *,
    distance: float,
    target: Float[Tensor, " 3"],
    irradiance: float,
    ambient: float,
    flash: float = 0.0,
    far: bool = False,
    sweep_deg: float = 160.0,
    elevations_deg: tuple[float, float] = (18.0, 72.0),
) -> Lights:
    """Draw positions of a point light round an object, on the photographed side; float64.

    Args:
        azimuths: Radians about the world's z, counter-clockwise from -y: the centre of the
            point light's sweep in each photograph.
        distance: From the target, scene units; drawn up to a quarter nearer or farther.
        irradiance: Mean over the views; drawn up to a quarter less or more.
        far: Whether light comes from one direction and does not fall off.
        elevations_deg: Lowest and highest position of the point light over the table's plane.
    """
    count = len(azimuths)
    square = _even_square(count, generator)
    rotation = azimuths + torch.deg2rad(sweep_deg * (square[:, 0] - 0.5))
    lowest, highest = torch.deg2rad(torch.tensor(elevations_deg)).sin().tolist()
    sine = lowest + (highest - lowest) * square[:, 1]  # uniform over the solid angle
    cosine = (1 - sine**2).sqrt()
    direction = torch.stack([cosine * rotation.sin(), -cosine * rotation.cos(), sine], dim=-1)
    strengths = irradiance, ambient, flash
    return _placed(direction, target, generator, distance, strengths, _FAR if far else 1.0)


def _placed(
    direction: Float[Tensor, "view 3"],
    target: Float[Tensor, " 3"],
    generator: torch.Generator,
    distance: float,
    strengths: tuple[float, float, float],
    farther: float = 1.0,
) -> Lights:
    """Draw distances and strengths of point lights, up to a quarter less or more."""
    count = len(direction)
    away = distance * _about_one(count, generator)
    irradiance, ambient, flash = strengths
    return Lights(
        positions_world=target + farther * away[:, None] * direction,
        irradiance=irradiance * _about_one(count, generator),
        ambient=ambient * _about_one(count, generator),
        target_world=target,
        flash=torch.full((count,), flash, dtype=torch.float64),
    )


def _about_one(count: int, generator: torch.Generator) -> Float[Tensor, " view"]:
    return 0.75 + 0.5 * torch.rand(count, generator=generator, dtype=torch.float64)


def _even_square(count: int, generator: torch.Generator) -> Float[Tensor, "view 2"]:
    """Spread points over the unit square.

    The plastic number's sequence fills it evenly however few its points are, so that a dozen
    photographs already have lights from all sides (Roberts, 2018).
    """
    steps = torch.arange(count, dtype=torch.float64)[:, None]
    start = torch.rand(2, generator=generator, dtype=torch.float64)
    return torch.remainder(start + steps * start.new_tensor([0.7548776662, 0.5698402910]), 1)
