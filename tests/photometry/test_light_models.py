"""The models of a view's light against their derivatives, their bounds and the light field."""

import pytest
import torch
from draws import normal
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.lighting.light_field import LightField, harmonics, second_harmonics
from pimper_torch.lighting.light_models import (
    MIN_DISTANCE,
    ImageSamples,
    LightModel,
    left_out,
    predicts_better,
)
from pimper_torch.linalg.robust import CAUCHY_TUNING


def basis(normals):
    return torch.cat([harmonics(normals), second_harmonics(normals)], dim=1)


@pytest.fixture
def samples(generator):
    return normalize(normal(generator, 50, 3), dim=1), 0.5 * normal(generator, 50, 3)


def lights(generator, model, views=6):
    """Return lights within all bounds; point lights are three times as far as the samples."""
    soft = normal(generator, views, model.basis.shape[1])
    soft[:, 0] = 0.1 + soft[:, 0].abs()
    if model.points is None:
        return soft
    point_light = normal(generator, views, 3), torch.full((views, 1), 0.3).double()
    return torch.cat([soft, *point_light], dim=1)


@pytest.fixture(params=["soft", "point light", "room"])
def model(request, samples):
    normals, points = samples
    if request.param == "soft":
        return LightModel(basis=harmonics(normals))
    terms = {"point light": 1, "room": 9}[request.param]
    return LightModel(basis=basis(normals)[:, :terms], normals=normals, points=points)


def test_the_jacobian_is_the_derivative_of_shading(model, generator):
    given = lights(generator, model)
    whole = torch.autograd.functional.jacobian(model.shade, given)  # sample, view, view, parameter
    view = torch.arange(len(given))
    found = model.jacobian(given)
    assert_close(found, whole[:, view, view])
    assert (found.abs().amax(dim=0) > 0).all()
    off = whole.clone()
    off[:, view, view] = 0
    assert (off == 0).all()  # the shading of a view depends on its light only


def test_shading_matches_the_light_field(samples, generator):
    normals, points = samples
    model = LightModel(basis=basis(normals), normals=normals, points=points)
    given = lights(generator, model)
    field = LightField(
        origin=torch.zeros(3).double(),
        soft=given[:, :9],
        point_light=given[:, 9:12],
        inverse_distance=given[:, 12],
    )
    direct = (field.point_light_at(points) * normals[:, None]).sum(dim=-1).clamp_min(0)
    assert_close(model.shade(given), basis(normals) @ field.soft.mT + direct)


def test_parameters_are_clamped_and_bounds_marked(samples):
    normals, points = samples
    outside = torch.tensor([[-1.0, 2, -3, 4, -0.5], [1.0, 0, 0, 1, 9.0], [1.0, 0, 0, 1, 0.2]])
    model = LightModel(basis=harmonics(normals)[:, :1], normals=normals, points=points)
    inside = model.clamp(outside.double())
    expected = outside.double()
    expected[0, 0], expected[0, 4], expected[1, 4] = 0, 0, 1 / MIN_DISTANCE
    assert_close(inside, expected)
    assert_close(model.clamp(inside), inside)
    free = torch.ones(3, 5, dtype=torch.bool)
    free[0, 0] = free[0, 4] = free[1, 4] = False
    assert (model.inside_bounds(inside) == free).all()
    soft = LightModel(basis=harmonics(normals))
    assert_close(soft.clamp(outside[:, :4].double()), expected[:, :4])
    assert (soft.inside_bounds(inside[:, :4]) == free[:, :4]).all()


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


def test_a_fifth_of_seen_samples_is_held_out_per_sample_and_view(generator):
    found = left_out(torch.ones(100, 10, dtype=torch.bool))
    assert (found.sum(dim=0) == 20).all()
    assert (found.sum(dim=1) == 2).all()
    seen = torch.rand(100, 10, generator=generator) > 0.5
    assert (left_out(seen) == found & seen).all()


def test_a_gain_must_be_significant_and_large_enough(generator):
    simpler = 1 + 0.1 * torch.rand(12, generator=generator)
    assert predicts_better(0.9 * simpler, simpler)
    assert not predicts_better(0.97 * simpler, simpler)
    assert not predicts_better(simpler, 0.9 * simpler)
    uneven = torch.where(torch.arange(12) < 6, 0.5, 1.7)  # 4 % better, uncertain by 18 %
    assert not predicts_better(uneven * simpler, simpler)


def test_views_without_held_out_samples_are_ignored():
    simpler = torch.tensor([1.0, 1.01, torch.nan, 1.0])
    assert predicts_better(0.5 * torch.tensor([1.0, 1.0, 1.0, torch.nan]), simpler)
    assert not predicts_better(torch.full((4,), torch.nan), simpler)
    assert not predicts_better(torch.tensor([0.5, torch.nan]), torch.ones(2))
