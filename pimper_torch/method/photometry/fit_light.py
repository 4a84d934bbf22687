"""The light of every view, which all patches share, fitted to the surface."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.rigid import invert_rigid, rotate
from pimper_torch.ground.geometry.template_normals import transferred_normals
from pimper_torch.ground.shapes import PatchVectors, Scalar
from pimper_torch.method.photometry.factor_priors import RELATIVE_NOISE
from pimper_torch.method.photometry.light_field import (
    LightField,
    harmonics,
    linearized,
    rotate_lights,
)
from pimper_torch.method.photometry.lights import light_of_mesh
from pimper_torch.method.photometry.photometry_config import FitLightConfig
from pimper_torch.method.photometry.sample_estimates import gather_samples, initial_shading
from pimper_torch.records import PatchPriors, PatchViews, Record
from pimper_torch.runtime.stage import Stage

# Guessed normals suit the photographs better if residuals fall below this fraction: a choice. True
# ones with smooth errors of 10 degrees lower them to 0.63 on a jar's first pass, and normals that
# all face the camera to 0.98.
_GUESS_GAIN = 0.95

# Information of the surface's normals where there are guesses, too: a choice, 5.4 degrees, as
# much as the weight of their prior says.
_SURFACE_INFORMATION = 0.1 / RELATIVE_NOISE**2


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Illumination(Record):
    """The light of all views.

    Attributes:
        shadows: Whether the surface casts shadows.
        guess_variance: Of the difference of guessed normals from the surface's beyond what both
            claim, squared radians; 0 where they suit the photographs better.
    """

    field: LightField
    shadows: bool
    guess_variance: Scalar


class FitLight(Stage):
    """Fit the light of every view to the normals of the surface that the templates carry.

    Soft light, or a near point light, in a lit room where there is one; its colour and exposure
    are those that the factorization divides out. Few samples of all patches are enough, see
    :func:`~pimper_torch.method.photometry.lights.thinned`.

    Differentiable in the radiance and the normals, by the implicit function theorem; the model,
    colours and exposures of views, and a room's harmonics over its ambient light, are constant.
    """

    def __init__(self, config: FitLightConfig | None = None) -> None:
        super().__init__()
        self.config = config or FitLightConfig()

    def forward(self, seen: PatchViews) -> Illumination:
        """Fit it.

        Args:
            seen: Of all patches, whose templates may be thinned.
        """
        coarse = [transferred_normals(seen.patches.coarse, each) for each in seen.patches.buckets]
        field = self._field(seen, coarse)
        variance = field.soft.new_zeros(())
        guesses = [bucket.priors for bucket in seen.buckets]
        if any(each is not None and bool(each.normal_information.any()) for each in guesses):
            led = [_beside_guesses(*pair) for pair in zip(coarse, guesses, strict=True)]
            under = self._field(seen, led)
            # The photographs decide whether the surface or the guess is nearer to the truth.
            if _misfit(seen, under, led) < _GUESS_GAIN * _misfit(seen, field, coarse):
                field = under
            else:
                variance = _excess_variance(coarse, guesses)
        shadows = self.config.shadows and bool(field.point_light.any())
        return Illumination(field=field, shadows=shadows, guess_variance=variance)

    def _field(self, seen: PatchViews, normals: list[Float[Tensor, "_ _ _ 3"]]) -> LightField:
        config = self.config
        return light_of_mesh(seen, normals, config.min_views, config.model, config.colours)


def lights_in_patches(
    field: LightField, patch_from_world: Float[Tensor, "patch 4 4"]
) -> tuple[
    Float[Tensor, "patch view 4"], Float[Tensor, "patch view 4"], Float[Tensor, "patch view 3"]
]:
    """Return first-order light at the centres of patches, soft light alone, and the point light."""
    centre, outward = invert_rigid(patch_from_world)[:, :3, 3], -patch_from_world[:, 2, :3]
    both, soft = field.lights_at(centre, outward), linearized(field.soft, outward)
    point_light = rotate(patch_from_world, field.point_light_at(centre))
    return rotate_lights(patch_from_world, both), rotate_lights(patch_from_world, soft), point_light


def _misfit(seen: PatchViews, field: LightField, normals: list[Float[Tensor, "_ _ _ 3"]]) -> float:
    """Return the median residual of normals under a light field, over what it predicts."""
    found = []
    for templates, registered, own in zip(seen.patches.buckets, seen.buckets, normals, strict=True):
        rows = gather_samples(templates, registered, own)
        lights, _, _ = lights_in_patches(templates.own(field), templates.patch_from_world.to(own))
        gray, basis = rows.radiance.mean(dim=2), harmonics(rows.normals).mT
        predicted = lights @ initial_shading(gray, rows.seen, lights, basis)
        some = rows.seen & (predicted > 0)
        found.append(((gray - predicted).abs() / predicted.clamp_min(1e-12))[some])
    return float(torch.cat(found).detach().median()) if sum(map(len, found)) else math.inf


def _excess_variance(
    normals: list[Float[Tensor, "_ _ _ 3"]], guesses: list[PatchPriors | None]
) -> Scalar:
    """Return the variance of guessed normals about the surface's, beyond what both claim."""
    square, claimed = [], []
    for own, guess in zip(normals, guesses, strict=True):
        if guess is not None:
            some = guess.normal_information > 0
            square.append((guess.normals_patch - own)[some].square().sum(dim=-1))
            claimed.append(1 / guess.normal_information[some])
    # Half of the squares of two Gaussian components lie below 2 log 2 times their variance.
    found = torch.cat(square).median() / math.log(2)
    claims = torch.cat(claimed).median() + 1 / _SURFACE_INFORMATION
    return (found - claims).clamp_min(0)


def _beside_guesses(normals: PatchVectors, guessed: PatchPriors | None) -> PatchVectors:
    """Average the surface's normals with those that were guessed, where there are any."""
    if guessed is None:
        return normals
    information = guessed.normal_information[..., None]
    both = _SURFACE_INFORMATION * normals + information * guessed.normals_patch
    return torch.where(information > 0, normalize(both, dim=-1), normals)
