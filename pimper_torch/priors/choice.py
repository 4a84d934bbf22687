"""Significance test for the conventions of maps.

A candidate is the data under a different convention. Its scores measure how well it fits the
scene, one score per point of the cloud or outline.
"""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from pimper_torch.runtime.errors import InputError, caution

# Least gain in score for maps that are reoriented or have channels exchanged: a choice. It finds
# all mirrored, half turned and exchanged normals of rendered scenes (potatoes, jar, balls, mug, 12
# of 160x120) without noise and with 25 degrees, including maps of the object alone, except those of
# the jar, which is its own mirror image.
_MIN_GAIN = 0.05


def doubt(message: str, trained: bool) -> None:
    """Raise an error, or give a warning for stated conventions of a network in training.

    Its maps need not fit the scene yet. The warning has one text, which Python shows once.
    """
    if not trained:
        raise InputError(message)
    caution(
        "Maps that require gradients contradict the scene; they are used as stated, as of a "
        "network in training. Detached maps are refused, with the reason.",
        stacklevel=5,
    )


def clearly_better(scores: Float[Tensor, " point"], baseline: Float[Tensor, " point"]) -> bool:
    """Return whether the mean of scores exceeds a baseline's by 4 standard errors.

    ``False`` for fewer than 8 points.
    """
    differences = scores - baseline
    if len(differences) < 8:
        return False
    error = differences.std() / len(differences) ** 0.5
    return float(differences.mean() / error.clamp_min(1e-9)) > 4


def better_change(
    unchanged: Float[Tensor, " point"],
    changes: Sequence[tuple[str, Float[Tensor, "reading point"]]],
    least: float = 0.0,
) -> str:
    """Return the name of the change with which maps fit significantly better, else "".

    Scores are 0 where maps have no value.

    Args:
        changes: Names of changes, and the scores of all readings of maps with that change.
        least: Least mean score, where maps have values, for a change to be credible.
    """
    if len(unchanged) == 0 or not changes:
        return ""
    best_readings = [(name, scores[scores.mean(dim=1).argmax()]) for name, scores in changes]
    name, best = max(best_readings, key=lambda change: float(change[1].mean()))
    fraction = float((best != 0).float().mean())
    needed = max(least * fraction, float(unchanged.mean()) + _MIN_GAIN * fraction)
    return name if float(best.mean()) > needed and clearly_better(best, unchanged) else ""
