"""What surrounds a scene, infinitely far away: the picture that a mirror shows."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.evidence.scenes.noise import random_speckle
from pimper_torch.evidence.scenes.scene_object import Texture
from pimper_torch.geometry.directions import even_directions

_WINDOWS = 6
_WINDOW_RADIANCE = 6.0  # of the brightest wall


@dataclass(frozen=True, slots=True, kw_only=True)
class Environment:
    """An environment map in closed form: patterned walls with bright windows.

    Attributes:
        walls: Radiance in unit directions of its own frame.
        windows: In its own frame; rows of each: the unit direction of its centre, and two
            vectors across it, one over the tangents of half its width and height long.
        own_from_world: Rotation.
        scale: Multiplies all radiance.
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
