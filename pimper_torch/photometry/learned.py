"""A prior of the factorization that was trained on rendered scenes, lights given."""

from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import normalize

from pimper_torch.errors import InputError
from pimper_torch.photometry.cone import tangents
from pimper_torch.photometry.factor_priors import FactorPrior, Known, PatchSamples
from pimper_torch.photometry.light_field import harmonics

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

_FEATURES = 9


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
            nn.Linear(_FEATURES, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
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
