"""How radiance becomes a photograph."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.config import require, require_at_most


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

    supersample: int = 2
    read_noise: float = 0.002
    shot_noise: float = 0.0001
    exposure: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what no sensor does."""
        require(self.supersample >= 1, "supersample", self.supersample, "1 or more")
        require(self.read_noise >= 0, "read_noise", self.read_noise, "0 or more")
        require(self.shot_noise >= 0, "shot_noise", self.shot_noise, "0 or more")
        require(self.exposure > 0, "exposure", self.exposure, "more than 0")
        # In multiples of full scale.
        require_at_most(self, read_noise=1.0, shot_noise=1.0, exposure=1000.0)
        # Rays a pixel and direction: 256 tell all that 8 or 16 bits can.
        require_at_most(self, supersample=16)


def expose(
    radiance: Float[Tensor, "channel height width"],
    generator: torch.Generator,
    sensor: SensorConfig,
) -> Float[Tensor, "channel height width"]:
    """Add noise and saturate.

    Args:
        radiance: Already multiplied by the exposure; without limit.
        generator: Of the noise.
        sensor: Its faults.
    """
    spread = (sensor.read_noise**2 + sensor.shot_noise * radiance).sqrt()
    noise = torch.randn(radiance.shape, generator=generator, dtype=radiance.dtype)
    return (radiance + spread * noise).clamp(0, 1)
