"""Radiance of samples in all views, and residuals of a model under Cauchy's loss.

Parameters of a model are paid for by radiance that was left out of the fit.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.kernels.twin_constants import CAUCHY_TUNING, MIN_DEVIATION
from pimper_torch.photometry.robust import cauchy_weights, robust_deviation

# Residuals have to fall by so many standard errors over the views, 99.7 % confidence, and by this
# fraction at least, a choice: what won less on glossy scenes was no light.
_CONFIDENCE, _LEAST = 3.0, 0.05


def left_out(seen: Bool[Tensor, "sample view"]) -> Bool[Tensor, "sample view"]:
    """Choose what to leave out: of each sample and each view a fifth."""
    sample, view = (torch.arange(size, device=seen.device) for size in seen.shape)
    return seen & ((sample[:, None] + view) % 5 == 0)


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


@dataclass(frozen=True, kw_only=True)
class ImageSamples:
    """Radiance of samples in all views.

    Attributes:
        radiance: Gray, linear; zero where not seen.
        seen: False where missing.
    """

    radiance: Float[Tensor, "sample view"]
    seen: Bool[Tensor, "sample view"]

    def at(self, index: slice | tuple[slice, slice]) -> "ImageSamples":
        """Take some samples, or some samples in some views."""
        return ImageSamples(radiance=self.radiance[index], seen=self.seen[index])

    @cached_property
    def level(self) -> Float[Tensor, " view"]:
        """Mean brightness of each view."""
        return (self.radiance.sum(dim=0) / self.seen.sum(dim=0).clamp_min(1)).abs()

    def residual(
        self, albedo: Float[Tensor, " sample"], shading: Float[Tensor, "sample view"]
    ) -> Float[Tensor, "sample view"]:
        """Return the residuals of a model of albedo and shading; zero where not seen."""
        return torch.where(self.seen, self.radiance - albedo[:, None] * shading, 0)

    def scale(self, residual: Float[Tensor, "sample view"]) -> Float[Tensor, " view"]:
        """Return the scale of Cauchy's loss for each view."""
        least = MIN_DEVIATION * self.level
        return CAUCHY_TUNING * robust_deviation(residual.mT, self.seen.mT).maximum(least)

    def weights(
        self, residual: Float[Tensor, "sample view"], scale: Float[Tensor, " view"]
    ) -> Float[Tensor, "sample view"]:
        """Return Cauchy's weights; zero where not seen."""
        return self.seen * cauchy_weights(residual, scale)

    def brightness(self) -> tuple[Float[Tensor, " view"], Float[Tensor, " sample"]]:
        """Return median radiance of each view, and of each sample relative to its views."""
        missing = torch.where(self.seen, self.radiance, torch.nan)
        gain = missing.nanmedian(dim=0).values.nan_to_num(nan=0.0)
        known = self.seen & (gain > 0)
        ratio = torch.where(known, self.radiance / gain.clamp_min(1e-300), torch.nan)
        albedo = ratio.nanmedian(dim=1).values.nan_to_num(nan=0.0)
        return gain, torch.where(known.any(dim=1), albedo, 0)

    def albedo_under(
        self, shading: Float[Tensor, "sample view"], weight: Float[Tensor, "sample view"]
    ) -> Float[Tensor, " sample"]:
        """Return the weighted least-squares albedo under a shading; NaN without weight."""
        square = (weight * shading**2).sum(dim=1)
        product = (weight * shading * self.radiance).sum(dim=1)
        return torch.where(square > 0, product / torch.where(square > 0, square, 1), torch.nan)
