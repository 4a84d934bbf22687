"""Random quantities of one part of a scene, independent of those of every other part."""

import math
import zlib
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

Option = TypeVar("Option")


class Draws:
    """A random stream with its distributions; float64.

    Args:
        seed: Of the scene.
        part: Name of the stream; those of other names are independent of it.
    """

    def __init__(self, seed: int, part: str) -> None:
        sequence = np.random.SeedSequence((seed, zlib.crc32(part.encode())))
        state = sequence.generate_state(1, np.uint64)[0]
        self.generator = torch.Generator().manual_seed(int(state >> np.uint64(1)))

    def uniform(self, low: float, high: float) -> float:
        """Draw a number."""
        return float(self.vector(low, high, 1))

    def log_uniform(self, low: float, high: float) -> float:
        """Draw a positive number of uniform logarithm."""
        return math.exp(self.uniform(math.log(low), math.log(high)))

    def chance(self, probability: float) -> bool:
        """Return true with a probability."""
        return self.uniform(0, 1) < probability

    def integer(self, low: int, high: int) -> int:
        """Draw an integer from ``low`` to ``high``, both included."""
        return int(torch.randint(low, high + 1, (), generator=self.generator))

    def pick(self, options: Sequence[Option]) -> Option:
        """Draw one of several options."""
        return options[self.integer(0, len(options) - 1)]

    def vector(self, low: float, high: float, *shape: int) -> Tensor:
        """Draw independent numbers."""
        samples = torch.rand(shape, generator=self.generator, dtype=torch.float64)
        return low + (high - low) * samples

    def direction(self) -> Float[Tensor, " 3"]:
        """Draw a unit vector, uniform over the sphere."""
        return normalize(torch.randn(3, generator=self.generator, dtype=torch.float64), dim=0)

    def rotation(self) -> Float[Tensor, "3 3"]:
        """Draw a rotation, uniform over all of them."""
        quaternion = torch.randn(4, generator=self.generator, dtype=torch.float64)
        w, x, y, z = normalize(quaternion, dim=0).tolist()
        return quaternion.new_tensor(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )


def about_z(radians: float) -> Float[Tensor, "3 3"]:
    """Return a rotation about the vertical axis."""
    cosine, sine = math.cos(radians), math.sin(radians)
    return torch.tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], dtype=torch.float64)
