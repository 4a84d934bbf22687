"""Priors of the factorization: each tells something of lights, normals, albedo or outliers.

A factorization takes a list of them. Leaving one out removes its effect, and one that is written
elsewhere, such as a network, is added to the list: nothing else names it. :class:`LearnedPrior` was
trained on rendered scenes, lights given.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import normalize

from pimper_torch.errors import InputError
from pimper_torch.photometry.cone import tangents
from pimper_torch.photometry.light_field import harmonics
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
class Known(Record):
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

    def forward(self, samples: PatchSamples) -> Known:
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

    def forward(self, samples: PatchSamples) -> Known:
        """Return the field's lights."""
        weight = torch.full_like(samples.lights[..., 0], self.weight)
        return Known(lights=samples.lights, light_weight=weight)


class SurfaceNormals(FactorPrior):
    """Normals are those of the surface so far.

    Args:
        weight: In views.
    """

    def __init__(self, weight: float = 0.1) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, samples: PatchSamples) -> Known:
        """Return the surface's normals."""
        weight = torch.full_like(samples.albedo, self.weight)
        return Known(normals=samples.normals, normal_weight=weight)


class Guesses(FactorPrior):
    """Normals, albedo, lights and inliers are those that views carry, to their variance.

    Albedo and lights are taken up to a factor for each patch.
    """

    def forward(self, samples: PatchSamples) -> Known:
        """Return the guesses in units of the light field and the albedo under it."""
        albedo, albedo_weight = _guessed_albedo(samples)
        lights, light_weight = _guessed_lights(samples)
        information = samples.guessed_information
        return Known(
            normals=samples.guessed_normals,
            normal_weight=None if information is None else views_worth(information),
            albedo=albedo,
            albedo_weight=albedo_weight,
            lights=lights,
            light_weight=light_weight,
            inlier=samples.guessed_inlier,
        )


def _guessed_albedo(
    samples: PatchSamples,
) -> tuple[Float[Tensor, "patch sample"] | None, Float[Tensor, "patch sample"] | None]:
    guess, variance = samples.guessed_albedo, samples.guessed_albedo_variance
    if guess is None or variance is None:
        return None, None
    both = (guess > 0) & (samples.albedo > 0)
    if not bool(both.any()):
        return None, None
    ratio = torch.where(both, samples.albedo / torch.where(both, guess, 1), torch.nan)
    factor = ratio.nanmedian(dim=1, keepdim=True).values.nan_to_num(nan=0.0)
    return factor * guess, torch.where(both, views_worth(1 / variance), 0)


def _guessed_lights(
    samples: PatchSamples,
) -> tuple[Float[Tensor, "patch view 4"] | None, Float[Tensor, "patch view"] | None]:
    lights, variance = samples.guessed_lights, samples.guessed_light_variance
    if lights is None or variance is None:
        return None, None
    length = lights.norm(dim=2)
    known = variance.isfinite() & (length > 0)
    ratio = samples.lights.norm(dim=2) / torch.where(known, length, torch.nan)
    factor = ratio.nanmedian(dim=1, keepdim=True).values.nan_to_num(nan=0.0)
    # The field itself is 6 degrees off: a variance of 0.01 of its square.
    return factor[..., None] * lights, torch.where(known, 0.01 / torch.where(known, variance, 1), 0)


def views_worth(information: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return the views that tell as much of an angle or of relative albedo; one at most.

    So photographs overrule guesses.
    """
    return (RELATIVE_NOISE**2 * information).clamp_max(1)


# That come with the package: 6,000 steps as in `benchmarks/train_prior.py`, see docs/priors.md.
WEIGHTS = Path(__file__).with_name("learned.safetensors")

# Largest tilt from the surface so far, radians, and largest weight, in views: choices.
_MAX_TILT, _MAX_WEIGHT = 0.3, 4.0

# Relative radiance and tilt are bounded softly at this: a choice, highlights are far above.
_BOUND = 3.0

# Ridge of the tilt's equations, in squares of relative radiance: a choice.
_RIDGE = 0.01

# Width of highlights, in cosines between normal and halfway vector: a choice, 18 degrees.
_LOBE = 0.05


class LearnedPrior(FactorPrior):
    r"""A small network that guesses normals, and which entries show diffuse reflection.

    An entry is a view of a sample. Its features are radiance and prediction relative to the
    sample's mean prediction, their difference, the light's cosine and its tilt, the cosines of the
    viewer and of the halfway vector, and the difference along the tilt that fits all views best. A
    layer that all entries share follows, then mean and
    maximum over the views that see the sample, then a layer of both. So the order of views does not
    matter, and normals rotate with patch and lights.

    The guessed normal is the surface's, tilted by the sum of two parts: the least-squares tilt of
    what the network takes as diffuse, and the tangents of lights and halfway vectors, weighed by
    the network.

    Differentiable in parameters and samples.
    """

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.entry = nn.Sequential(
            nn.Linear(9, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
        )
        self.pooled = nn.Sequential(nn.Linear(2 * width, width), nn.SiLU())
        self.own, self.shared = nn.Linear(width, width), nn.Linear(width, width)
        self.of_entry, self.of_sample = nn.Linear(width, 3), nn.Linear(width, 2)

    @classmethod
    def trained(cls, path: Path = WEIGHTS) -> "LearnedPrior":
        """Read trained weights; they require no gradients.

        Raises:
            InputError: The file is missing, or of another network.
        """
        needed = "needed: the weights of `LearnedPrior`, which come with the package"
        if not path.is_file():
            raise InputError(f"{path}: there is no such file; {needed}. Install it again.")
        prior = cls()
        try:
            prior.load_state_dict(load_file(path))
        except (OSError, SafetensorError, RuntimeError) as error:
            raise InputError(f"{path}: cannot be read ({error}); {needed}.") from error
        return prior.requires_grad_(requires_grad=False)

    def forward(self, samples: PatchSamples) -> Known:
        """Guess normals and inliers."""
        seen, normals = samples.seen, samples.normals
        n_basis = harmonics(normals).mT
        shading = samples.lights @ n_basis
        count = seen.sum(dim=1, keepdim=True).clamp_min(1)
        mean = (shading * seen).sum(dim=1, keepdim=True) / count
        unit = 1 / mean.clamp_min(1e-6)
        albedo = samples.albedo.clamp_min(1e-6)[:, None]
        predicted = _bounded(shading * unit)
        residual = torch.where(seen, _bounded(samples.radiance / albedo * unit) - predicted, 0)
        along = [samples.lights[..., 1:] @ tangent.mT * unit for tangent in tangents(normals)]
        bound = (1 + (along[0].square() + along[1].square()) / _BOUND**2).rsqrt()
        along = [part * bound for part in along]
        direction = normalize(samples.lights[..., 1:], dim=-1)
        viewers = samples.viewers
        if viewers is None:
            viewers = direction.new_tensor([0.0, 0.0, -1.0]).expand_as(direction)
        halfway = normalize(direction + viewers, dim=-1)
        mirror = halfway @ normals.mT
        fit = _tilt(along, residual, predicted, seen.to(residual.dtype))
        features = torch.stack(
            [
                residual,
                predicted,
                direction @ normals.mT,
                viewers @ normals.mT,
                mirror,
                ((mirror - 1) / _LOBE).exp(),
                _length(along),
                along[0] * fit[0][:, None] + along[1] * fit[1][:, None],
                _length(fit)[:, None].expand_as(residual),
            ],
            dim=-1,
        )
        inner = self.entry(features.to(self.own.weight))
        shown = seen[..., None]
        average = (inner * shown).sum(dim=1) / count.mT.to(inner).reshape(*normals.shape[:2], 1)
        largest = inner.masked_fill(~shown, -1).amax(dim=1)
        pooled = self.pooled(torch.cat([average, largest], dim=-1))
        joined = nn.functional.silu(self.own(inner) + self.shared(pooled)[:, None])
        logit, push, glare = self.of_entry(joined).to(residual).unbind(dim=-1)
        pull, gate = self.of_sample(pooled).to(residual).unbind(dim=-1)
        inlier = torch.sigmoid(logit)
        fit = _tilt(along, residual, predicted, inlier * seen)
        tilt = torch.stack(
            [
                torch.sigmoid(gate) * own
                + ((push * part + glare * (halfway @ tangent.mT)) * seen).sum(dim=1) / count[:, 0]
                for own, part, tangent in zip(fit, along, tangents(normals), strict=True)
            ]
        )
        tilt = tilt * (1 + tilt.square().sum(dim=0) / _MAX_TILT**2).rsqrt()
        first, second = tangents(normals)
        guessed = normals + tilt[0][..., None] * first + tilt[1][..., None] * second
        return Known(
            normals=normalize(guessed, dim=-1),
            normal_weight=_MAX_WEIGHT * torch.sigmoid(pull),
            inlier=inlier,
        )


def _bounded(values: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    return values * (1 + values.square() / _BOUND**2).rsqrt()


def _length(pair: list[Float[Tensor, "*batch"]]) -> Float[Tensor, "*batch"]:
    # Smooth at 0, where nothing is seen.
    return (pair[0].square() + pair[1].square() + _RIDGE**2).sqrt()


def _tilt(
    along: list[Float[Tensor, "patch view sample"]],
    residual: Float[Tensor, "patch view sample"],
    predicted: Float[Tensor, "patch view sample"],
    weight: Float[Tensor, "patch view sample"],
) -> list[Float[Tensor, "patch sample"]]:
    """Return the least-squares tilt along two tangents, albedo free."""

    def total(
        one: Float[Tensor, "patch view sample"], other: Float[Tensor, "patch view sample"]
    ) -> Float[Tensor, "patch sample"]:
        return (weight * one * other).sum(dim=1)

    square = total(predicted, predicted) + _RIDGE
    x, y, r = (
        part - (total(predicted, part) / square)[:, None] * predicted for part in (*along, residual)
    )
    a, b, c = total(x, x) + _RIDGE, total(x, y), total(y, y) + _RIDGE
    first, second = total(x, r), total(y, r)
    determinant = a * c - b * b
    return [(c * first - b * second) / determinant, (a * second - b * first) / determinant]
