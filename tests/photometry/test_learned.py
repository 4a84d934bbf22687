import statistics

import pytest
import torch
from torch.nn.functional import normalize

import pimper_torch as pt
from pimper_torch.errors import InputError
from pimper_torch.evidence.datasets.rendered import read_rendered
from pimper_torch.evidence.metrics.evaluation import EvaluateConfig, evaluate
from pimper_torch.geometry.rigid import rotate
from pimper_torch.io.estimates import estimate_of
from pimper_torch.photometry.factor_priors import WEIGHTS, LearnedPrior, PatchSamples
from pimper_torch.photometry.factorize import Factorize, FactorizeConfig
from pimper_torch.photometry.light_field import harmonics, rotate_lights


@pytest.fixture
def prior():
    torch.manual_seed(2)
    return LearnedPrior().double()


@pytest.fixture
def samples(generator):
    """Two patches of noisy radiance, 6 views and 9 samples, some of them missing."""

    def rand(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    normals = normalize(torch.cat([rand(2, 9, 2) - 0.5, -1 - rand(2, 9, 1)], dim=-1), dim=-1)
    soft, toward = (
        0.3 + rand(2, 6, 1),
        normalize(rand(2, 6, 3) - torch.tensor([0.5, 0.5, 1.5]), dim=-1),
    )
    lights, albedo = torch.cat([soft, toward], dim=-1), 0.2 + rand(2, 9)
    seen = rand(2, 6, 9) < 0.8
    radiance = albedo[:, None] * (lights @ harmonics(normals).mT) * (1 + 0.3 * rand(2, 6, 9))
    viewers = normalize(rand(2, 6, 3) - torch.tensor([0.5, 0.5, 1.5]), dim=-1)
    return PatchSamples(
        radiance=radiance * seen,
        seen=seen,
        normals=normals,
        albedo=albedo,
        lights=lights,
        viewers=viewers,
    )


def test_the_order_of_views_does_not_matter(prior, samples, generator):
    order = torch.randperm(6, generator=generator)
    shuffled = samples.replace(
        radiance=samples.radiance[:, order],
        seen=samples.seen[:, order],
        lights=samples.lights[:, order],
        viewers=samples.viewers[:, order],
    )
    one, other = prior(samples), prior(shuffled)
    assert torch.allclose(one.normals, other.normals, atol=1e-12)
    assert torch.allclose(one.normal_weight, other.normal_weight, atol=1e-12)
    assert torch.allclose(one.inlier[:, order], other.inlier, atol=1e-12)


def test_normals_rotate_with_patch_and_lights(prior, samples):
    angle = torch.tensor(0.7, dtype=torch.float64)
    about_z = torch.eye(4, dtype=torch.float64)
    about_z[:2, :2] = torch.stack(
        [torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])]
    )
    rotated = samples.replace(
        normals=rotate(about_z, samples.normals),
        lights=rotate_lights(about_z, samples.lights),
        viewers=rotate(about_z, samples.viewers),
    )
    one, other = prior(samples), prior(rotated)
    assert torch.allclose(rotate(about_z, one.normals), other.normals, atol=1e-12)
    assert torch.allclose(one.inlier, other.inlier, atol=1e-12)


def test_units_of_albedo_and_lights_do_not_matter(prior, samples):
    other = samples.replace(lights=samples.lights * 3, albedo=samples.albedo / 3)
    brighter = other.replace(radiance=samples.radiance * 5, albedo=other.albedo * 5)
    one, two = prior(samples), prior(brighter)
    assert torch.allclose(one.normals, two.normals, atol=1e-12)
    assert torch.allclose(one.inlier, two.inlier, atol=1e-12)


def test_what_is_not_seen_does_not_matter(prior, samples):
    junk = torch.where(samples.seen, samples.radiance, 7.0)
    one, other = prior(samples), prior(samples.replace(radiance=junk))
    assert torch.equal(one.normals, other.normals)
    assert torch.equal(one.normal_weight, other.normal_weight)


def test_missing_or_foreign_weights_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"there is no such file; needed: the weights"):
        LearnedPrior.trained(tmp_path / "none.safetensors")
    foreign = tmp_path / "foreign.safetensors"
    foreign.write_bytes(b"no weights")
    with pytest.raises(InputError, match=r"cannot be read .* needed: the weights"):
        LearnedPrior.trained(foreign)


def test_the_package_holds_small_weights_that_require_no_gradients():
    assert WEIGHTS.stat().st_size < 300_000
    (learned,) = (
        one
        for one in Factorize(FactorizeConfig(learned=True)).priors
        if isinstance(one, LearnedPrior)
    )
    assert not any(value.requires_grad for value in learned.parameters())
    assert not any(isinstance(one, LearnedPrior) for one in Factorize().priors)


def errors(scene, preset):
    """Median and mean error of the normals of a surface, degrees, over all views."""
    capture = read_rendered(scene)
    views = pt.load_views(scene / "photos", masks=scene / "masks")
    found = pt.load_chain(preset)(views, scene / "truth" / "sparse")
    config = EvaluateConfig(samples=20_000, views=capture.views.names)
    off = [one.transferred_normals for one in evaluate(estimate_of(found), capture, config).views]
    return tuple(
        statistics.fmean(getattr(one, f"{kind}_deg") for one in off) for kind in ("median", "mean")
    )
