"""How radiance becomes a photograph."""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.config import Range, require_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorConfig:
    """A sensor's faults.

    Attributes:
        supersample: Rays a pixel, along each side, where neighbouring pixels differ; one ray
            where they do not.
        read_noise: Standard deviation in the dark; 1 is saturation.
        shot_noise: Variance that light adds, as a fraction of its radiance.
        exposure: Radiance is multiplied by it before it saturates at 1.
    """

    supersample: Annotated[int, Range(least=1, most=16)] = 2
    read_noise: Annotated[float, Range(least=0, most=1)] = 0.002
    shot_noise: Annotated[float, Range(least=0, most=1)] = 0.0001
    exposure: Annotated[float, Range(above=0, most=1000)] = 1.0

    def __post_init__(self) -> None:
        """Refuse what no sensor does."""
        require_ranges(self)


def expose(
    radiance: Float[Tensor, "channel height width"],
    generator: torch.Generator,
    sensor: SensorConfig,
) -> Float[Tensor, "channel height width"]:
    """Add noise and saturate.

    Args:
        radiance: Already multiplied by the exposure; without limit.
    """
    spread = (sensor.read_noise**2 + sensor.shot_noise * radiance).sqrt()
    noise = torch.randn(radiance.shape, generator=generator, dtype=radiance.dtype)
    return (radiance + spread * noise).clamp(0, 1)
