"""The problem of a batch of patches: its samples, their priors, and initial values."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.linalg.robust import Loss
from pimper_torch.records import Observations
from pimper_torch.records.shapes import PatchRaster, Scalar
from pimper_torch.stages.photometry.bilinear import Bilinear, Shading
from pimper_torch.stages.photometry.cone import Cone
from pimper_torch.stages.photometry.factor_priors import PatchSamples, PriorTerms
from pimper_torch.stages.photometry.sample_estimates import FlatSamples, flatten_samples


def patch_samples(
    rows: FlatSamples,
    gray: Float[Tensor, "patch view sample"],
    field: Float[Tensor, "patch view 4"],
    albedo: Float[Tensor, "patch sample"],
    registered: Observations,
    variance: Scalar,
) -> PatchSamples:
    """Return the samples for the priors; ``variance`` is added to that of the views' normals."""
    priors = registered.priors
    samples = PatchSamples(
        radiance=gray,
        seen=rows.seen,
        normals=rows.normals,
        albedo=albedo,
        lights=field,
        viewers=registered.viewers,
    )
    if priors is None:
        return samples

    def row(raster: PatchRaster) -> Float[Tensor, "patch sample"]:
        return raster.flatten(1).gather(1, rows.index)

    normals, information = priors.normals_patch.flatten(1, 2), priors.normal_information
    inlier = priors.inlier
    return samples.replace(
        guessed_normals=normals.gather(1, rows.index[..., None].expand(-1, -1, 3)),
        guessed_information=row(information / (1 + information * variance)),
        guessed_albedo=row(priors.albedo),
        guessed_albedo_variance=row(priors.albedo_variance),
        guessed_inlier=None if inlier is None else flatten_samples(inlier, rows.index),
        guessed_lights=priors.lights_patch,
        guessed_light_variance=priors.light_variance,
    )


def build_problem(
    samples: PatchSamples,
    shading: Shading,
    terms: Sequence[PriorTerms],
    undetermined: Bool[Tensor, " patch"],
    loss: Loss,
    stride: int,
) -> Bilinear:
    """Return the problem of samples and the priors on them.

    Args:
        shading: Initial values.
        undetermined: Patches whose light does not determine normals.
        stride: Every such sample is used for the residuals' deviation.
    """
    cone, field = Cone(), samples.lights
    weight = samples.seen.to(samples.radiance.dtype)
    for term in terms:
        if term.inlier is not None:
            weight = weight * term.inlier
    prior_mean, light_weight = _prior_mean(field, terms)
    square = shading[:, 0] ** 2
    count = (square > 0).sum(dim=1).clamp_min(1)
    seen_square = (weight @ square[..., None])[..., 0]
    # 16 mean samples are added, for views with few samples.
    unit = seen_square + (16 * square.sum(dim=1) / count)[:, None]
    views = samples.seen.any(dim=2).sum(dim=1).clamp_min(1)
    light_power = (field**2).sum(dim=(1, 2)) / views
    # If light does not determine normals, 30 views move them by 3 % of the way.
    pulls = [(samples.normals, torch.where(undetermined, 1e3, 0)[:, None].expand_as(square))]
    pulls += [
        (term.normals, torch.where(undetermined[:, None], 0, term.normal_weight))
        for term in terms
        if term.normals is not None and term.normal_weight is not None
    ]
    prior: Float[Tensor, "patch packed sample"] | None = None
    for normals, pull in pulls:
        if bool((pull > 0).any()):
            penalty = (light_power[:, None] * pull)[:, None] * cone.normal_prior(normals.mT)
            prior = penalty if prior is None else prior + penalty
    problem = Bilinear(
        radiance=samples.radiance,
        weight=weight,
        lights=prior_mean,
        prior_mean=prior_mean,
        shading=shading,
        # A millionth of the data, at least, determines the light of views with few samples.
        regularization=light_weight.clamp_min(1e-6) * unit,
        prior=prior,
        manifold=cone,
        loss=loss,
        stride=stride,
    )
    for term in terms:
        if term.albedo is not None and term.albedo_weight is not None:
            problem = _with_albedo(problem, term.albedo, term.albedo_weight, light_power)
    return problem


def _prior_mean(
    field: Float[Tensor, "patch view 4"], terms: Sequence[PriorTerms]
) -> tuple[Float[Tensor, "patch view 4"], Float[Tensor, "patch view"]]:
    """Return the weighted mean of the priors' lights, and the sum of the weights."""
    priors = [
        (term.lights, term.light_weight)
        for term in terms
        if term.lights is not None and term.light_weight is not None
    ]
    if len(priors) == 1:
        return priors[0]
    total = torch.zeros_like(field[..., 0])
    mean = torch.zeros_like(field)
    for lights, weight in priors:
        total, mean = total + weight, mean + weight[..., None] * lights
    weighted = (total > 0)[..., None]
    return torch.where(weighted, mean / torch.where(weighted, total[..., None], 1), field), total


def _with_albedo(
    problem: Bilinear,
    albedo: Float[Tensor, "patch sample"],
    weight: Float[Tensor, "patch sample"],
    light_power: Float[Tensor, " patch"],
) -> Bilinear:
    """Return the problem with a view added: albedo under ambient light of mean strength."""
    strength = light_power.sqrt()[:, None]
    light = pad(strength[..., None], (0, 3))
    fixed = 1e6 * problem.regularization.amax(dim=1, keepdim=True)
    return problem.replace(
        radiance=torch.cat([problem.radiance, (strength * albedo)[:, None]], dim=1),
        weight=torch.cat([problem.weight, weight[:, None]], dim=1),
        lights=torch.cat([problem.lights, light], dim=1),
        prior_mean=torch.cat([problem.prior_mean, light], dim=1),
        regularization=torch.cat([problem.regularization, fixed], dim=1),
    )
