"""The light of every view, common to all patches, fitted to the surface."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.rigid import invert_rigid, rotate
from pimper_torch.geometry.template_normals import transferred_normals
from pimper_torch.lighting.light_field import (
    LightField,
    harmonics,
    linearized,
    rotate_lights,
)
from pimper_torch.lighting.lights import light_of_mesh
from pimper_torch.records import Observations, PatchPriors, PatchViews, Record
from pimper_torch.records.shapes import PatchVectors, Scalar
from pimper_torch.stages.photometry.factor_priors import RELATIVE_NOISE
from pimper_torch.stages.photometry.photometry_config import FitLightConfig
from pimper_torch.stages.photometry.sample_estimates import gather_samples, initial_shading
from pimper_torch.stages.stage import Stage

# The views' prior normals are used for the light if they reduce residuals below this fraction: a
# choice. True normals with smooth errors of 10 degrees reduce them to 0.63 in a jar's first pass,
# and normals that all face the camera to 0.98.
_GUESS_GAIN = 0.95

# Information of the surface's normals where prior normals exist as well: a choice, 5.4 degrees, as
# the weight of their prior in the factorization.
_SURFACE_INFORMATION = 0.1 / RELATIVE_NOISE**2


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Illumination(Record):
    """The light of all views.

    Attributes:
        shadows: Whether the surface casts shadows.
        guess_variance: Variance of the difference between prior normals and the surface's, in
            excess of the stated variances, squared radians; 0 if prior normals fit better.
    """

    field: LightField
    shadows: bool
    guess_variance: Scalar


class FitLight(Stage):
    """Fit the light of every view to the normals of the templates' surface.

    It is soft light, or a near point light, possibly in a lit room. The factorization divides out
    its colour and exposure. A few samples of all patches are enough, see
    :func:`~pimper_torch.lighting.lights.thinned`.

    Differentiable in the radiance and the normals, by the implicit function theorem; the model,
    colours and exposures of views, and a room's harmonics over its ambient light, are constant.
    """

    kept_as = Illumination

    def __init__(self, config: FitLightConfig | None = None) -> None:
        super().__init__()
        self.config = config or FitLightConfig()

    def forward(self, seen: PatchViews) -> Illumination:
        """Return the light of all views, from samples of all patches, which may be thinned."""
        coarse = [transferred_normals(seen.patches.coarse, each) for each in seen.patches.buckets]
        field = self._field(seen, coarse)
        variance = field.soft.new_zeros(())
        guesses = [bucket.priors for bucket in seen.buckets]
        if any(each is not None and bool(each.normal_information.any()) for each in guesses):
            normals = [_with_priors(*pair) for pair in zip(coarse, guesses, strict=True)]
            refitted = self._field(seen, normals)
            # The residuals decide whether the surface or the prior normals are more accurate.
            if _misfit(seen, refitted, normals) < _GUESS_GAIN * _misfit(seen, field, coarse):
                field = refitted
            else:
                variance = _excess_variance(coarse, guesses)
        shadows = self.config.shadows and bool(field.point_light.any())
        return Illumination(field=field, shadows=shadows, guess_variance=variance)

    def _field(self, seen: PatchViews, normals: list[Float[Tensor, "_ _ _ 3"]]) -> LightField:
        config = self.config
        return light_of_mesh(seen, normals, config.min_views, config.model, config.colours)


def balanced(registered: Observations, field: LightField) -> Observations:
    """Return radiance over each view's gain, and prior lights over its exposure, both constant."""
    priors = registered.priors
    if field.gain is None or field.exposure is None or bool((field.gain == 1).all()):
        return registered
    gain, exposure = field.gain.detach(), field.exposure.detach()
    if priors is not None and priors.lights_patch is not None:
        lights = priors.lights_patch / exposure[:, None].to(priors.lights_patch)
        registered = registered.replace(priors=priors.replace(lights_patch=lights))
    radiance = registered.radiance / gain[..., None, None].to(registered.radiance)
    return registered.replace(radiance=radiance)


def lights_in_patches(
    field: LightField, patch_from_world: Float[Tensor, "patch 4 4"]
) -> tuple[
    Float[Tensor, "patch view 4"], Float[Tensor, "patch view 4"], Float[Tensor, "patch view 3"]
]:
    """Return first-order light at the centres of patches, soft light only, and point light."""
    centre, outward = invert_rigid(patch_from_world)[:, :3, 3], -patch_from_world[:, 2, :3]
    full, soft = field.lights_at(centre, outward), linearized(field.soft, outward)
    point_light = rotate(patch_from_world, field.point_light_at(centre))
    return rotate_lights(patch_from_world, full), rotate_lights(patch_from_world, soft), point_light


def _misfit(seen: PatchViews, field: LightField, normals: list[Float[Tensor, "_ _ _ 3"]]) -> float:
    """Return the median residual over the predicted radiance, for a light field and normals."""
    residuals = []
    for templates, samples, normal in zip(seen.patches.buckets, seen.buckets, normals, strict=True):
        rows = gather_samples(templates, samples, normal)
        lights = lights_in_patches(templates.own(field), templates.patch_from_world.to(normal))[0]
        gray, basis = rows.radiance.mean(dim=2), harmonics(rows.normals).mT
        predicted = lights @ initial_shading(gray, rows.seen, lights, basis)
        valid = rows.seen & (predicted > 0)
        residuals.append(((gray - predicted).abs() / predicted.clamp_min(1e-12))[valid])
    return float(torch.cat(residuals).detach().median()) if sum(map(len, residuals)) else math.inf


def _excess_variance(
    normals: list[Float[Tensor, "_ _ _ 3"]], guesses: list[PatchPriors | None]
) -> Scalar:
    """Return the variance of prior normals about the surface's, in excess of the stated ones."""
    squares, variances = [], []
    for bucket_normals, guess in zip(normals, guesses, strict=True):
        if guess is not None:
            valid = guess.normal_information > 0
            squares.append((guess.normals_patch - bucket_normals)[valid].square().sum(dim=-1))
            variances.append(1 / guess.normal_information[valid])
    # The median of the sum of two squared Gaussian components is 2 log 2 times their variance.
    variance = torch.cat(squares).median() / math.log(2)
    stated = torch.cat(variances).median() + 1 / _SURFACE_INFORMATION
    return (variance - stated).clamp_min(0)


def _with_priors(normals: PatchVectors, priors: PatchPriors | None) -> PatchVectors:
    """Return the surface's normals, averaged with prior normals where they exist."""
    if priors is None:
        return normals
    information = priors.normal_information[..., None]
    total = _SURFACE_INFORMATION * normals + information * priors.normals_patch
    return torch.where(information > 0, normalize(total, dim=-1), normals)
