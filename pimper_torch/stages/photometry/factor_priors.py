"""Priors of the factorization, on lights, normals, albedo or outliers.

The factorization takes a list of priors, and nothing else depends on them: to disable one, remove
it from the list; to use a custom one, such as a network, append it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pimper_torch.records import Record
from pimper_torch.records.shapes import Scalars

# Standard deviation of residuals over the radiance of albedo 1: a choice, in the middle of rendered
# scenes. It converts variances to weights: a normal with a standard error of 5.4 degrees has the
# weight of a tenth of a view.
RELATIVE_NOISE = 0.03


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PatchSamples(Record):
    """A batch of patches before factorization, samples flattened; ``guessed_*``: the views' priors.

    Attributes:
        radiance: Gray, linear; zero where missing.
        seen: False where missing, and in the padding.
        normals: Normals of the current surface, unit, patch frame.
        albedo: Gray least-squares albedo for these normals and the lights.
        lights: First-order harmonics of the light field, patch frame.
        viewers: Direction to each camera, unit, patch frame; ``None`` if unknown.
        guessed_normals: Unit, patch frame.
        guessed_information: Inverse variance of these, one over squared radians; 0 where unknown.
        guessed_albedo: Gray, up to a factor; 0 where unknown.
        guessed_albedo_variance: Relative.
        guessed_inlier: Probability of diffuse reflection; 1 where unknown.
        guessed_lights: Patch frame, up to a factor.
        guessed_light_variance: Relative; infinite where unknown.
    """

    radiance: Float[Tensor, "patch view sample"]
    seen: Bool[Tensor, "patch view sample"]
    normals: Float[Tensor, "patch sample 3"]
    albedo: Float[Tensor, "patch sample"]
    lights: Float[Tensor, "patch view 4"]
    viewers: Float[Tensor, "patch view 3"] | None = None
    guessed_normals: Float[Tensor, "patch sample 3"] | None = None
    guessed_information: Float[Tensor, "patch sample"] | None = None
    guessed_albedo: Float[Tensor, "patch sample"] | None = None
    guessed_albedo_variance: Float[Tensor, "patch sample"] | None = None
    guessed_inlier: Float[Tensor, "patch view sample"] | None = None
    guessed_lights: Float[Tensor, "patch view 4"] | None = None
    guessed_light_variance: Float[Tensor, "patch view"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PriorTerms(Record):
    """Means and weights of a prior on a batch of patches; ``None`` for quantities without prior.

    Attributes:
        lights: Patch frame.
        light_weight: In units of the weight of each view's data.
        normals: Unit, patch frame.
        normal_weight: In views, see :func:`views_worth`.
        albedo: Gray, in the scale of the lights.
        albedo_weight: In views.
        inlier: Factor of the weight of every entry, in [0, 1].
    """

    lights: Float[Tensor, "patch view 4"] | None = None
    light_weight: Float[Tensor, "patch view"] | None = None
    normals: Float[Tensor, "patch sample 3"] | None = None
    normal_weight: Float[Tensor, "patch sample"] | None = None
    albedo: Float[Tensor, "patch sample"] | None = None
    albedo_weight: Float[Tensor, "patch sample"] | None = None
    inlier: Float[Tensor, "patch view sample"] | None = None


class FactorPrior(nn.Module):
    """A prior of the factorization; a custom one overrides :meth:`forward`."""

    def forward(self, samples: PatchSamples) -> PriorTerms:
        """Return means and weights for a batch of patches."""
        raise NotImplementedError


class FieldLights(FactorPrior):
    """Prior of the lights, with the light field as mean.

    Args:
        weight: In units of the weight of each view's data.
    """

    def __init__(self, weight: float = 1.0) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, samples: PatchSamples) -> PriorTerms:
        """Return the lights of the field and their weight."""
        weight = torch.full_like(samples.lights[..., 0], self.weight)
        return PriorTerms(lights=samples.lights, light_weight=weight)


class SurfaceNormals(FactorPrior):
    """Prior of the normals, with those of the current surface as mean.

    Args:
        weight: In views.
    """

    def __init__(self, weight: float = 0.1) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, samples: PatchSamples) -> PriorTerms:
        """Return the normals of the surface and their weight."""
        weight = torch.full_like(samples.albedo, self.weight)
        return PriorTerms(normals=samples.normals, normal_weight=weight)


class MapPriors(FactorPrior):
    """Prior of normals, albedo, lights and inliers from the views' prior maps and variances."""

    def forward(self, samples: PatchSamples) -> PriorTerms:
        """Return prior maps; albedo and lights are scaled per patch, by the light field."""
        terms = PriorTerms(normals=samples.guessed_normals, inlier=samples.guessed_inlier)
        if (information := samples.guessed_information) is not None:
            terms = terms.replace(normal_weight=views_worth(information))
        albedo, variance = samples.guessed_albedo, samples.guessed_albedo_variance
        if albedo is not None and variance is not None:
            valid = (albedo > 0) & (samples.albedo > 0)
            if bool(valid.any()):
                scale = _median_ratio(samples.albedo, albedo, valid)
                weight = torch.where(valid, views_worth(1 / variance), 0)
                terms = terms.replace(albedo=scale * albedo, albedo_weight=weight)
        lights, variance = samples.guessed_lights, samples.guessed_light_variance
        if lights is not None and variance is not None:
            length = lights.norm(dim=2)
            valid = variance.isfinite() & (length > 0)
            scale = _median_ratio(samples.lights.norm(dim=2), length, valid)
            # The error of the field is 6 degrees: a variance of 0.01 of its square.
            weight = torch.where(valid, 0.01 / torch.where(valid, variance, 1), 0)
            terms = terms.replace(lights=scale[..., None] * lights, light_weight=weight)
        return terms


def _median_ratio(
    values: Float[Tensor, "patch item"], guess: Float[Tensor, "patch item"], mask: Tensor
) -> Float[Tensor, "patch 1"]:
    """Return each patch's median ratio of values to guesses; 0 if the mask is empty."""
    ratio = torch.where(mask, values / torch.where(mask, guess, 1), torch.nan)
    return ratio.nanmedian(dim=1, keepdim=True).values.nan_to_num(nan=0.0)


def views_worth(information: Scalars) -> Scalars:
    """Return the number of views with the same information on an angle or on relative albedo."""
    # At most one, so that photographs outweigh priors.
    return (RELATIVE_NOISE**2 * information).clamp_max(1)
