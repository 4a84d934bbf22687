import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.geometry.rigid import rigid, rotate
from pimper_torch.lighting.light_field import harmonics, rotate_lights, second_harmonics
from pimper_torch.lighting.light_fit import LightFit
from pimper_torch.lighting.light_models import ImageSamples, LightModel
from pimper_torch.lighting.lights import _fit_room, fit_light_field


def data(generator, samples=800, views=9):
    n = torch.randn(samples, 3, generator=generator, dtype=torch.float64)
    n[:, 2] = -n[:, 2].abs() - 0.5
    n = normalize(n, dim=1)
    lights = 0.4 * torch.randn(views, 4, generator=generator, dtype=torch.float64)
    lights[:, 0] += 1.5
    rho = 0.2 + torch.rand(samples, generator=generator, dtype=torch.float64)
    lights = lights / lights.norm(dim=1).median()
    return rho[:, None] * (harmonics(n) @ lights.mT), n, lights, rho


def test_lights_survive_a_fifth_of_gross_outliers(generator):
    J, n, lights, _ = data(generator)
    J = J + 0.002 * torch.randn(J.shape, generator=generator, dtype=torch.float64)
    gross = torch.rand(J.shape, generator=generator) < 0.2
    J = torch.where(gross, 4 * torch.rand(J.shape, generator=generator, dtype=torch.float64), J)
    found = fit_light_field(J, torch.ones_like(gross), n, model="soft").soft[:, :4]
    # 0.002 of noise leaves 0.005 along the valley where albedo mimics light; plain least
    # squares would be off by 0.5.
    assert (found - lights).abs().max() < 0.02


def test_a_view_without_samples_is_dark_and_does_not_affect_others(generator):
    J, n, lights, _ = data(generator)
    seen = torch.ones(J.shape, dtype=torch.bool)
    seen[:, 3] = False
    found = fit_light_field(J, seen, n).soft[:, :4]
    others = torch.arange(9) != 3
    assert (found[3] == 0).all()
    scale = lights[others].norm(dim=1).median()
    assert_close(found[others], lights[others] / scale, rtol=1e-5, atol=1e-5)


def test_constant_light_leaves_the_shared_soft_light_unchanged(generator):
    _, n, _, rho = data(generator)
    model = LightModel(basis=harmonics(n)[:, :1], normals=n, points=n)
    lights = torch.tensor([0.6, 0.1, 0.2, -0.8, 0.0]).double().expand(9, 5)
    J = rho[:, None] * model.shade(lights)
    J = J + 0.01 * torch.randn(J.shape, generator=generator, dtype=torch.float64)
    samples = ImageSamples(radiance=J, seen=torch.ones_like(J) > 0)
    basis = torch.cat([harmonics(n), second_harmonics(n)], dim=1)
    room = torch.eye(9, dtype=torch.float64)[:1]
    found = _fit_room(LightFit(model=model, lights=lights, albedo=rho), samples, basis, room)
    # Both sides of the equations are zero up to rounding: their quotient would be arbitrary.
    assert_close(found, room, rtol=0, atol=1e-3)


def test_shading_is_the_same_in_every_frame(generator):
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    target_from_source = rigid(rotation, torch.ones(3, dtype=torch.float64))
    lights = torch.randn(5, 4, generator=generator, dtype=torch.float64)
    n = torch.randn(7, 3, generator=generator, dtype=torch.float64)
    rotated = (
        rotate_lights(target_from_source, lights) @ harmonics(rotate(target_from_source, n)).mT
    )
    assert_close(rotated, lights @ harmonics(n).mT)


def test_lights_fitted_in_groups_are_exact(generator, monkeypatch):
    J, n, lights, _ = data(generator, views=11)
    seen = torch.rand(J.shape, generator=generator) > 0.3
    monkeypatch.setattr("pimper_torch.lighting.lights._TOGETHER", 4)
    found = fit_light_field(torch.where(seen, J, torch.nan), seen, n)
    assert (found.point_light == 0).all()
    assert_close(found.soft[:, :4], lights, rtol=1e-5, atol=1e-5)  # one scale for all groups


@pytest.mark.slow
def test_gradients_of_lights_fitted_in_groups_match_differences(generator, monkeypatch):
    J, n, _, _ = data(generator, samples=40, views=7)
    J = J + 0.01 * torch.randn(J.shape, generator=generator, dtype=torch.float64)
    change = 0.01 * torch.randn(J.shape, generator=generator, dtype=torch.float64)
    weight = torch.randn(7, 9, generator=generator, dtype=torch.float64)
    monkeypatch.setattr("pimper_torch.lighting.lights._TOGETHER", 4)

    def evaluate(step):
        radiance = (J + step * change).requires_grad_()
        field = fit_light_field(radiance, torch.ones_like(J) > 0, n, model="soft")
        return (field.soft * weight).sum(), radiance

    value, radiance = evaluate(0.0)
    (gradient,) = torch.autograd.grad(value, radiance)
    step = 1e-4
    difference = (evaluate(step)[0] - evaluate(-step)[0]).detach() / (2 * step)
    assert_close((gradient * change).sum(), difference, rtol=1e-3, atol=0)


@pytest.mark.parametrize("model", ["soft", "point_light"])
def test_gradients_of_a_light_field_match_differences(generator, model):
    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    normals = normalize(draw(300, 3), dim=1)
    points = normals + 0.1 * draw(300, 3)
    away = 4 * normalize(draw(6, 3), dim=1) - points[:, None]
    facing = (normals[:, None] * away).sum(dim=2).clamp_min(0) / away.norm(dim=2) ** 3
    albedo = 0.3 + torch.rand(300, generator=generator, dtype=torch.float64)
    radiance = albedo[:, None] * (0.02 + 10 * facing) + 0.003 * draw(300, 6)
    seen = torch.rand(radiance.shape, generator=generator) < 0.8
    weights = draw(6, 9), draw(6, 3), draw(6)
    data = {"radiance": radiance, "normals": normals, "points": points}

    def evaluate(values):
        leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
        field = fit_light_field(seen=seen, model=model, **leaves)
        parts = field.soft, field.point_light, field.inverse_distance
        total = sum((a * b).sum() for a, b in zip(weights, parts, strict=True))
        return total, leaves

    total, leaves = evaluate(data)
    slopes = dict(zip(data, torch.autograd.grad(total, leaves.values()), strict=True))
    step = 1e-6
    for name, value in data.items():
        way = draw(*value.shape)
        ends = [evaluate(data | {name: value + sign * step * way})[0].detach() for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        # Central differences leave six digits.
        assert_close((slopes[name] * way).sum(), expected, rtol=1e-5, atol=1e-6)
