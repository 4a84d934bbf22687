"""The light of each photograph of a rendered scene."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Lights(Record):
    """A point light and an even ambient light for each view.

    A point of albedo 1 facing the point light at ``target_world`` has radiance
    ``irradiance + ambient``; elsewhere the former falls off with the square of the
    distance. A light placed very far away is a directional one.

    Attributes:
        positions_world: Of the point lights.
        irradiance: Of the point lights at the target.
        ambient: Radiance of a white point in shadow.
        target_world: Where irradiance is stated.
        flash: Irradiance at the target of a second light in the camera's own place, one a
            view, without shadows.
    """

    positions_world: Float[Tensor, "view 3"]
    irradiance: Float[Tensor, " view"]
    ambient: Float[Tensor, " view"]
    target_world: Float[Tensor, " 3"]
    flash: Float[Tensor, " view"]

    def harmonics_world(
        self, eyes_world: Float[Tensor, "view 3"] | None = None
    ) -> Float[Tensor, "view 4"]:
        """Give the first-order light ``l`` at the target: radiance is albedo * l . (1, n).

        Args:
            eyes_world: The cameras' centres, needed for the flash only.
        """
        toward = normalize(self.positions_world - self.target_world, dim=-1)
        directed = self.irradiance[:, None] * toward
        if eyes_world is not None:
            toward_eye = normalize(eyes_world - self.target_world, dim=-1)
            directed = directed + self.flash[:, None] * toward_eye
        return torch.cat([self.ambient[:, None], directed], dim=-1)


def wandering_lights(
    num_views: int,
    generator: torch.Generator,
    *,
    distance: float,
    spread_deg: float = 65.0,
    least_tilt_deg: float = 15.0,
    irradiance: float = 0.8,
    ambient: float = 0.12,
    flash: float = 0.0,
    target: tuple[float, float, float] = (0.0, 0.0, 0.0),
    toward: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Lights:
    """Carry a lamp to another place for every photograph; float64.

    Args:
        num_views: How many photographs.
        generator: Decides where the lamp goes, and how bright it is.
        distance: From the target, scene units; drawn up to a quarter nearer or farther.
        spread_deg: Greatest angle from ``toward``.
        least_tilt_deg: Smallest angle from ``toward``.
        irradiance: Mean over the views; drawn up to a quarter less or more.
        ambient: The same.
        flash: The same for every view.
        target: What is lit.
        toward: Axis of the cone the lamp moves in.
    """

    def uniform(low: float, high: float) -> Float[Tensor, " view"]:
        share = torch.rand(num_views, generator=generator, dtype=torch.float64)
        return low + (high - low) * share

    axis = normalize(torch.tensor(toward, dtype=torch.float64), dim=0)
    aside = torch.linalg.svd(axis[None]).Vh[1:]
    # The plastic number's sequence fills a square evenly however few its points are, so that
    # a dozen photographs already have lights from all sides (Roberts, 2018).
    steps = torch.arange(num_views, dtype=torch.float64)[:, None]
    square = torch.rand(2, generator=generator, dtype=torch.float64)
    square = torch.remainder(square + steps * square.new_tensor([0.7548776662, 0.5698402910]), 1)
    turn = 2 * torch.pi * square[:, 0]
    lowest, highest = torch.deg2rad(torch.tensor([spread_deg, least_tilt_deg])).cos().tolist()
    cosine = lowest + (highest - lowest) * square[:, 1]  # uniform over the solid angle
    sine = (1 - cosine**2).sqrt()
    across = turn.cos()[:, None] * aside[0] + turn.sin()[:, None] * aside[1]
    direction = cosine[:, None] * axis + sine[:, None] * across
    target_world = torch.tensor(target, dtype=torch.float64)
    return Lights(
        positions_world=target_world + (distance * uniform(0.75, 1.25))[:, None] * direction,
        irradiance=irradiance * uniform(0.75, 1.25),
        ambient=ambient * uniform(0.75, 1.25),
        target_world=target_world,
        flash=torch.full((num_views,), flash, dtype=torch.float64),
    )
