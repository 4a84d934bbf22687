"""Small spots whose normals are off where those around them are not.

Pimples and pits hardly move the mean or the median of all normals, but spoil the picture.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

# Pixels across the surroundings; how far off these may be in the mean, so that rims which are
# wrong as a whole are none, and how much further off a pit is, degrees.
_ACROSS, _SOUND_DEG, _EXCESS_DEG = 21, 3.0, 5.0


def pitted_percent(
    angle_deg: Float[Tensor, "height width"], known: Bool[Tensor, "height width"]
) -> float:
    """Return the fraction of known pixels that are 5 degrees further off than those around them.

    Those around, 21 x 21 pixels, must be less than 3 degrees off in the mean.

    Args:
        angle_deg: Of the normal's error; anything where it is not known.
        known: Where it is; somewhere at least.

    >>> angle = torch.zeros(50, 50)
    >>> angle[10, 10] = 20.0
    >>> pitted_percent(angle, torch.ones(50, 50, dtype=torch.bool))
    0.04
    """
    weight = known.double()
    both = torch.stack([torch.where(known, angle_deg, 0).double() * weight, weight])
    total, count = avg_pool2d(both, _ACROSS, stride=1, padding=_ACROSS // 2)
    around = total / torch.where(known, count, 1)
    pit = (around < _SOUND_DEG) & (angle_deg - around > _EXCESS_DEG)
    return 100 * float(pit[known].double().mean())
