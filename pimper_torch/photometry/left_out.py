"""Parameters are paid for by radiance that was left out of the fit."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# A fifth of the radiance is left out: a choice.
_LEFT_OUT = 5

# Residuals have to fall by so many standard errors over the views, 99.7 % confidence, and by this
# fraction at least, a choice: what won less on glossy scenes was no light.
_CONFIDENCE, _LEAST = 3.0, 0.05


def left_out(seen: Bool[Tensor, "sample view"]) -> Bool[Tensor, "sample view"]:
    """Choose what to leave out: of each sample and each view the same fraction."""
    sample, view = (torch.arange(size, device=seen.device) for size in seen.shape)
    return seen & ((sample[:, None] + view) % _LEFT_OUT == 0)


def predicts_better(misfit: Float[Tensor, " view"], simpler: Float[Tensor, " view"]) -> bool:
    """Decide whether a model predicts better than a simpler one, significantly.

    Args:
        misfit: Residuals of what was left out, one a view; NaN where there is none.
        simpler: Those of the simpler model.
    """
    gain = (simpler / misfit).log()
    gain = gain[gain.isfinite()]
    if len(gain) < 2:
        return False
    error = float(gain.std()) / math.sqrt(len(gain))
    return float(gain.mean()) > max(_CONFIDENCE * error, _LEAST)
