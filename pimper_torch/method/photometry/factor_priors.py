"""Priors of the factorization: each tells something of lights, normals, albedo or outliers.

A factorization takes a list of them. Leaving one out removes its effect, and one that is written
elsewhere, such as a network, is added to the list: nothing else names it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pimper_torch.ground.shapes import Scalars
from pimper_torch.records import Record

# Standard deviation of residuals over the radiance of albedo 1: a choice, in the middle of rendered
# scenes. By it variances become weights: a normal that is known to 5.4 degrees counts as a tenth of
# a view.
RELATIVE_NOISE = 0.03


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PatchSamples(Record):
    """A batch of patches before it is factorized, the samples of each in a row.

    Attributes:
        radiance: Gray, linear; zero where missing.
        seen: False where missing, and in the padding.
        normals: Of the surface so far, unit, patch frame.
        albedo: Gray, that suits these and the lights best.
        lights: Of the field, first-order harmonics in the patch frame.
        viewers: Direction to each camera, unit, patch frame; ``None`` where unknown.
        guessed_normals: That views carry, unit, patch frame.
        guessed_information: Inverse variance of these, one over squared radians; 0 where unknown.
        guessed_albedo: That views carry, gray, up to a factor; 0 where unknown.
        guessed_albedo_variance: Relative.
        guessed_inlier: Probability of diffuse reflection that views carry; 1 where unknown.
        guessed_lights: That views carry, patch frame, up to a factor.
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
    """Statement of a prior on a batch of patches; ``None`` where it makes none.

    Attributes:
        lights: Patch frame.
        light_weight: In units of each view's own data.
        normals: Unit, patch frame.
        normal_weight: In views, see :func:`views_worth`.
        albedo: Gray, in units of the lights.
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
    """A prior of the factorization; one of your own overrides :meth:`forward`."""

    def forward(self, samples: PatchSamples) -> PriorTerms:
        """Return what is known of some patches."""
        raise NotImplementedError


class FieldLights(FactorPrior):
    """Lights are those of the light field.

    Args:
        weight: In units of each view's own data.
    """

    def __init__(self, weight: float = 1.0) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, samples: PatchSamples) -> PriorTerms:
        """Return the field's lights."""
        weight = torch.full_like(samples.lights[..., 0], self.weight)
        return PriorTerms(lights=samples.lights, light_weight=weight)


class SurfaceNormals(FactorPrior):
    """Normals are those of the surface so far.

    Args:
        weight: In views.
    """

    def __init__(self, weight: float = 0.1) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, samples: PatchSamples) -> PriorTerms:
        """Return the surface's normals."""
        weight = torch.full_like(samples.albedo, self.weight)
        return PriorTerms(normals=samples.normals, normal_weight=weight)


class MapPriors(FactorPrior):
    """Normals, albedo, lights and inliers are those that views carry, to their variance.

    Albedo and lights are taken up to a factor for each patch.
    """

    def forward(self, samples: PatchSamples) -> PriorTerms:
        """Return the guesses in units of the light field and the albedo under it."""
        known = PriorTerms(normals=samples.guessed_normals, inlier=samples.guessed_inlier)
        if (information := samples.guessed_information) is not None:
            known = known.replace(normal_weight=views_worth(information))
        albedo, variance = samples.guessed_albedo, samples.guessed_albedo_variance
        if albedo is not None and variance is not None:
            both = (albedo > 0) & (samples.albedo > 0)
            if bool(both.any()):
                scale = _median_ratio(samples.albedo, albedo, both)
                weight = torch.where(both, views_worth(1 / variance), 0)
                known = known.replace(albedo=scale * albedo, albedo_weight=weight)
        lights, variance = samples.guessed_lights, samples.guessed_light_variance
        if lights is not None and variance is not None:
            length = lights.norm(dim=2)
            both = variance.isfinite() & (length > 0)
            scale = _median_ratio(samples.lights.norm(dim=2), length, both)
            # The field itself is 6 degrees off: a variance of 0.01 of its square.
            weight = torch.where(both, 0.01 / torch.where(both, variance, 1), 0)
            known = known.replace(lights=scale[..., None] * lights, light_weight=weight)
        return known


def _median_ratio(
    own: Float[Tensor, "patch item"], guess: Float[Tensor, "patch item"], known: Tensor
) -> Float[Tensor, "patch 1"]:
    """Return each patch's factor from guesses to its own values; 0 where nothing is known."""
    ratio = torch.where(known, own / torch.where(known, guess, 1), torch.nan)
    return ratio.nanmedian(dim=1, keepdim=True).values.nan_to_num(nan=0.0)


def views_worth(information: Scalars) -> Scalars:
    """Return the views that tell as much of an angle or of relative albedo; one at most.

    So photographs overrule guesses.
    """
    return (RELATIVE_NOISE**2 * information).clamp_max(1)
