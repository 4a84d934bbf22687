"""When one reading of data is believed in the place of another.

A candidate is the data as another convention has it. Its score says how well it fits the
photographs: at each of many places, or as the fraction of them that it explains.
"""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

# How much more maps must score, turned or with channels exchanged, than as they are: a choice. Of
# normals of rendered scenes (potatoes, jar, balls, mug, 12 of 160x120) without noise and with 25
# degrees, maps of the object alone included, mirrored, half turned and exchanged ones are found so,
# but for those of a jar that is its own mirror image.
_MORE = 0.05


def surely_better(one: Float[Tensor, " place"], other: Float[Tensor, " place"]) -> bool:
    """Return whether one candidate scores higher than another by 4 standard errors of the mean.

    Of fewer than 8 places none does.
    """
    differences = one - other
    if len(differences) < 8:
        return False
    error = differences.std() / len(differences) ** 0.5
    return float(differences.mean() / error.clamp_min(1e-9)) > 4


def better_otherwise(
    plain: Float[Tensor, " place"],
    others: Sequence[tuple[str, Float[Tensor, "reading place"]]],
    least: float = 0.0,
) -> str:
    """Name the change of maps with which they surely fit better than as they are, if any.

    Scores are 0 where maps say nothing.

    Args:
        others: Changes, and the scores of all readings of maps that are so changed.
        least: Mean score, where maps say something, that makes a change credible.
    """
    if len(plain) == 0 or not others:
        return ""
    fits = [(what, scores[scores.mean(dim=1).argmax()]) for what, scores in others]
    what, fit = max(fits, key=lambda one: float(one[1].mean()))
    share = float((fit != 0).float().mean())
    needed = max(least * share, float(plain.mean()) + _MORE * share)
    return what if float(fit.mean()) > needed and surely_better(fit, plain) else ""
