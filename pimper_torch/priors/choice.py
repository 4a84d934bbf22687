"""When one reading of data is believed in the place of another.

A candidate is the data as another convention has it. Its score says how well it fits what the
photographs show: at each of many places, or as the fraction of them that it explains.
"""

from jaxtyping import Float
from torch import Tensor


def surely_better(one: Float[Tensor, " place"], other: Float[Tensor, " place"]) -> bool:
    """Return whether one candidate scores higher than another by 4 standard errors of the mean.

    Of fewer than 8 places none does.
    """
    differences = one - other
    if len(differences) < 8:
        return False
    error = differences.std() / len(differences) ** 0.5
    return float(differences.mean() / error.clamp_min(1e-9)) > 4
