import pytest
import torch
from torch.testing import assert_close

from pimper_torch.lighting.light_models import ImageSamples
from pimper_torch.linalg.robust import CAUCHY_TUNING


@pytest.fixture
def drawn(generator):
    def random(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    seen = random(40, 7) > 0.3
    seen[3] = False
    radiance = torch.where(seen, random(40, 7), 0)
    return ImageSamples(radiance=radiance, seen=seen), random(40, 7) - 0.3, random(40, 7)


def test_albedo_is_that_of_weighted_least_squares(drawn):
    samples, shading, weight = drawn
    weight = weight * samples.seen
    found = samples.albedo_under(shading, weight)
    root = weight.sqrt()
    expected = torch.linalg.lstsq(
        (root * shading)[..., None], (root * samples.radiance)[..., None]
    ).solution[:, 0, 0]
    some = torch.arange(40) != 3
    assert_close(found[some], expected[some])
    assert found[3].isnan()


def test_weights_are_derivatives_of_the_loss(drawn):
    samples, shading, _ = drawn
    albedo = torch.full((40,), 0.4, dtype=torch.float64)
    residual = samples.residual(albedo, shading).requires_grad_()
    scale = samples.scale(residual.detach())
    cost = (samples.seen * scale**2 * torch.log1p((residual / scale) ** 2)).sum()
    (slope,) = torch.autograd.grad(cost, residual)
    # Half the derivative of the loss is weight times residual.
    assert_close(slope / 2, (samples.weights(residual, scale) * residual).detach())
    assert (samples.weights(residual, scale)[~samples.seen] == 0).all()


def test_residuals_without_noise_have_a_scale_above_zero(drawn):
    samples, _, _ = drawn
    scale = samples.scale(torch.zeros_like(samples.radiance))
    mean = samples.radiance.sum(dim=0) / samples.seen.sum(dim=0)
    assert_close(scale, CAUCHY_TUNING * 1e-4 * mean)


def test_brightness_factorizes_a_rank_one_product(generator):
    gain = torch.tensor([0.2, 1.0, 2.0, 0.0]).double()
    albedo = 0.1 + torch.rand(31, generator=generator, dtype=torch.float64)
    seen = torch.ones(31, 4, dtype=torch.bool)
    seen[5] = False
    radiance = torch.where(seen, albedo[:, None] * gain, 0)
    found, relative = ImageSamples(radiance=radiance, seen=seen).brightness()
    kept = torch.arange(31) != 5
    middle = albedo[kept].kthvalue(15).values  # the lower median of 30, as in torch
    assert_close(found, gain * middle)
    assert_close(relative[kept], albedo[kept] / middle)
    assert relative[5] == 0
