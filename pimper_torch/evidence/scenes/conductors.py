"""How metals mirror: Fresnel's equations with a complex refractive index.

Source: Born & Wolf, Principles of Optics, 7th ed. 1999, sections 1.5.2 and 14.2.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Conductor:
    """The complex refractive index of a metal, once for red, green and blue.

    Attributes:
        index: Real part.
        extinction: Imaginary part.
    """

    index: tuple[float, float, float]
    extinction: tuple[float, float, float]

    def reflectance(self, cosine: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch channel"]:
        """Return the fraction of unpolarized light that is mirrored.

        Args:
            cosine: Between the light and what it falls on, 0 to 1.
        """
        cosine = cosine.clamp(0, 1)[..., None]
        index = torch.complex(cosine.new_tensor(self.index), cosine.new_tensor(self.extinction))
        within = torch.sqrt(index**2 - (1 - cosine**2))  # index times the cosine in the metal
        across = (cosine - within) / (cosine + within)
        along = (index**2 * cosine - within) / (index**2 * cosine + within)
        return (across.abs() ** 2 + along.abs() ** 2) / 2


# At 650, 550 and 450 nm. Source: Johnson & Christy, Physical Review B 6(12), 1972.
CONDUCTORS = {
    "copper": Conductor(index=(0.21, 1.02, 1.16), extinction=(3.67, 2.58, 2.40)),
    "gold": Conductor(index=(0.17, 0.43, 1.38), extinction=(3.15, 2.46, 1.91)),
    "silver": Conductor(index=(0.05, 0.06, 0.04), extinction=(4.41, 3.59, 2.66)),
}
"""Metals by name."""
