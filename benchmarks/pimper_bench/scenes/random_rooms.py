"""Random rooms around the table of a rendered scene."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_bench.scenes.random_draws import Draws
from pimper_bench.scenes.random_surfaces import WALLS, random_colour
from pimper_bench.scenes.scene_object import Texture


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """The inside of a box, without cast shadows.

    Attributes:
        lowest: Corner of the box.
        highest: The opposite corner.
        glow: Irradiance of all its surfaces; ``None`` for that of the photograph's light.
    """

    lowest: Float[Tensor, " 3"]
    highest: Float[Tensor, " 3"]
    texture: Texture
    glow: float | None

    def seen(
        self, eye: Float[Tensor, " 3"], rays: Float[Tensor, "ray 3"]
    ) -> tuple[Float[Tensor, " ray"], Float[Tensor, "ray 3"]]:
        """Return the distances of the walls along rays from inside, and their normals."""
        low, high = self.lowest.to(rays), self.highest.to(rays)
        wall = torch.where(rays > 0, high, low)
        steps = torch.where(rays == 0, torch.inf, (wall - eye) / rays)
        distance, axis = steps.min(dim=1)
        normals = torch.zeros_like(rays)
        normals.scatter_(1, axis[:, None], -rays.sign().gather(1, axis[:, None]))
        return distance, normals


def random_room(draws: Draws, reach: float) -> Room | None:
    """Draw a room, or nothing behind the table.

    Args:
        reach: Cameras and lamps are at most this far from the table's centre.
    """
    half = 1.1 * reach * draws.vector(1.0, 1.6, 3)
    low = -half
    low[2] = -draws.log_uniform(0.4, 8.0)
    kind = draws.pick(list(WALLS))
    texture = WALLS[kind](draws, random_colour(draws), float(half.mean()) * draws.uniform(0.3, 1.0))
    glow = draws.log_uniform(0.08, 0.8) if draws.chance(0.5) else None
    if draws.chance(0.3):
        return None
    return Room(lowest=low, highest=half, texture=texture, glow=glow)
