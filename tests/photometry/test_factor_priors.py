import math

import pytest
import torch
from solved import solved
from torch import nn
from torch.testing import assert_close

from pimper_torch.records import PatchPriors
from pimper_torch.runtime.errors import ConfigError
from pimper_torch.stages.photometry.factor_priors import (
    FieldLights,
    MapPriors,
    SurfaceNormals,
    views_worth,
)
from pimper_torch.stages.photometry.factorize import Factorize
from pimper_torch.stages.photometry.photometry_config import FactorizeConfig
from tests.photometry.test_factorize import median_error


def carried(seen, **changes):
    """Return views with uninformative priors, except for the given values of every bucket."""
    buckets = []
    for index, bucket in enumerate(seen.buckets):
        blank = torch.zeros_like(bucket.radiance[:, 0, 0])
        priors = PatchPriors(
            normals_patch=torch.stack([blank, blank, blank - 1], dim=-1),
            normal_information=blank,
            offset=blank,
            offset_information=blank,
            albedo=blank,
            albedo_variance=torch.full_like(blank, math.inf),
        )
        own = {name: values[index] for name, values in changes.items()}
        buckets.append(bucket.replace(priors=priors.replace(**own)))
    return seen.replace(buckets=tuple(buckets))


def test_default_priors_are_those_of_the_settings(scene):
    seen = scene(bumps=0.2).seen
    found = solved(Factorize(FactorizeConfig(light_prior=0.5, geometry_weight=0.2)), seen)
    listed = solved(Factorize(priors=[FieldLights(0.5), SurfaceNormals(0.2)]), seen)
    unknowing = solved(
        Factorize(FactorizeConfig(light_prior=0.5, geometry_weight=0.2)), carried(seen)
    )
    for one, *others in zip(found.buckets, listed.buckets, unknowing.buckets, strict=True):
        for other in others:
            assert torch.equal(one.normals_patch, other.normals_patch)
            assert torch.equal(one.lights_patch, other.lights_patch)
    free = solved(Factorize(FactorizeConfig(light_prior=0.0, geometry_weight=0.2)), seen)
    without = solved(Factorize(priors=[SurfaceNormals(0.2)]), seen)
    for one, other in zip(free.buckets, without.buckets, strict=True):
        assert torch.equal(one.lights_patch, other.lights_patch)
    with pytest.raises(ConfigError, match="derived from FactorPrior"):
        Factorize(priors=[nn.Identity()])


def test_normal_priors_reduce_the_error_of_bumps(scene):
    true = scene(bumps=0.3)
    information = [torch.full_like(each[..., 0], math.radians(2) ** -2) for each in true.normals]
    seen = carried(true.seen, normals_patch=true.normals, normal_information=information)
    plain, led = solved(Factorize(), true.seen), solved(Factorize(), seen)
    assert median_error(led, true) < 0.8 * median_error(plain, true)


def test_albedo_priors_reduce_the_error_in_any_unit(scene):
    true = scene(bumps=0.2)
    priors = [FieldLights(), SurfaceNormals(0.0), MapPriors()]
    found = []
    for unit in (1.0, 7.0):
        albedo = [unit * each.mean(dim=-1) for each in true.albedo]
        variance = [torch.full_like(each, 1e-4) for each in albedo]
        seen = carried(true.seen, albedo=albedo, albedo_variance=variance)
        found.append(solved(Factorize(priors=priors), seen))
    for one, other, views in zip(*(each.buckets for each in found), true.seen.buckets, strict=True):
        assert_close(one.normals_patch, other.normals_patch, rtol=0, atol=1e-3)
        assert one.lights_patch.shape[1] == views.valid.shape[1]
    plain = solved(Factorize(priors=priors), true.seen)
    assert median_error(found[0], true) < median_error(plain, true)


def test_inlier_priors_suppress_outliers(scene):
    true = scene(bumps=0.2)
    spoilt, inlier = [], []
    for bucket in true.seen.buckets:
        wrong = torch.zeros_like(bucket.valid)
        wrong[:, :3, ::2] = True
        spoilt.append(bucket.replace(radiance=torch.where(wrong[:, :, None], 0.9, bucket.radiance)))
        inlier.append((~wrong).to(bucket.radiance))
    seen = true.seen.replace(buckets=tuple(spoilt))
    squares = FactorizeConfig(loss="squares")
    blind = median_error(solved(Factorize(squares), seen), true)
    knowing = median_error(solved(Factorize(squares), carried(seen, inlier=inlier)), true)
    assert knowing < 0.7 * blind
    deaf = solved(
        Factorize(squares, [FieldLights(), SurfaceNormals()]), carried(seen, inlier=inlier)
    )
    assert float(median_error(deaf, true)) > 0.9 * float(blind)


def test_light_priors_are_weighted_by_variance_in_any_unit(scene):
    true = scene(bumps=0.2)
    plain = solved(Factorize(priors=[FieldLights(1e6)]), true.seen)
    lights = [3.0 * bucket.lights_patch for bucket in plain.buckets]
    wrong = [each + each.norm(dim=2, keepdim=True) * 0.3 for each in lights]
    for variance, pulled in ((1e-6, True), (1e6, False)):
        variances = [torch.full_like(each[..., 0], variance) for each in lights]
        seen = carried(true.seen, lights_patch=wrong, light_variance=variances)
        found = solved(Factorize(priors=[FieldLights(1.0), MapPriors()]), seen)
        for one, given in zip(found.buckets, wrong, strict=True):
            cosine = torch.cosine_similarity(one.lights_patch, given, dim=2)
            assert bool((cosine > 0.9999).all()) == pulled


def test_views_worth_follows_from_information():
    information = torch.tensor([math.radians(5.44) ** -2, 0.0, 1e9])
    assert_close(views_worth(information), torch.tensor([0.1, 0.0, 1.0]), rtol=0.01, atol=1e-6)
