"""When one reading of data is believed in the place of another.

A candidate is the data as another convention has it. Its score says how well it fits what the
photographs show: at each of many places, or as the fraction of them that it explains.
"""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

# Standard errors by which one candidate must be better than another, and places it takes: choices.
ERRORS, _FEWEST = 4.0, 8
# Of what the data as given leave unexplained, the best may leave this fraction: a choice. Cameras
# of another convention explain up to 0.83 of the matches, where they stand on an arc and look at
# one point: turned about their axes, they are those of a mirrored relief. Right ones explain 0.97.
_LEFT = 0.5


def standard_errors(differences: Float[Tensor, " place"]) -> float:
    """Compute a mean in standard errors; 0 of too few."""
    if len(differences) < _FEWEST:
        return 0.0
    error = differences.std() / len(differences) ** 0.5
    return float(differences.mean() / error.clamp_min(1e-9))


def surely_better(one: Float[Tensor, " place"], other: Float[Tensor, " place"]) -> bool:
    """Return whether one candidate scores higher than another, place by place."""
    return standard_errors(one - other) > ERRORS


def far_better(given: float, scores: Sequence[float]) -> int | None:
    """Return the number of the best candidate, if it is far better than the data as given.

    Args:
        given: Fraction that the data as given explain.
        scores: Fractions that the candidates explain.
    """
    best = max(range(len(scores)), key=lambda index: scores[index], default=None)
    if best is None or 1 - scores[best] >= _LEFT * (1 - given):
        return None
    return best
