import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.geometry.rigid import rigid, rotate
from pimper_torch.lighting.light_field import (
    LightField,
    faces_light,
    harmonics,
    linearized,
    rotate_lights,
    second_harmonics,
)
from pimper_torch.lighting.light_fit import LightFit
from pimper_torch.lighting.light_models import ImageSamples, LightModel
from pimper_torch.lighting.lights import _fit_room, fit_light_field


@pytest.fixture
def room(generator):
    """Points and normals of a bumpy bowl, and six point lights three to six radii away."""

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    points = normalize(draw(900, 3), dim=1) + torch.tensor([5.0, -2.0, 1.0])
    normals = normalize(draw(900, 3) + torch.tensor([0.0, 0.0, 1.5]), dim=1)
    directions = normalize(draw(6, 3) * 0.6 + torch.tensor([0.0, 0.0, 1.0]), dim=1)
    field = LightField(
        origin=points.mean(dim=0),
        soft=torch.tensor([[0.1] + 8 * [0.0]], dtype=torch.float64).repeat(6, 1),
        point_light=torch.linspace(0.5, 1.5, 6).double()[:, None] * directions,
        inverse_distance=1 / torch.linspace(3, 6, 6).double(),
    )
    return points, normals, field


def seen_by(field, points, normals, albedo):
    point_light = field.point_light_at(points)
    direct = (point_light * normals[:, None]).sum(dim=-1).clamp_min(0)
    return albedo[:, None] * (field.soft[:, 0] + direct)


def test_a_point_light_falls_off_with_squared_distance():
    place = torch.tensor([0.0, 3.0, 4.0], dtype=torch.float64)
    field = LightField(
        origin=torch.zeros(3).double(),
        soft=torch.zeros(1, 9).double(),
        point_light=2.0 * place[None] / 5,
        inverse_distance=torch.tensor([1 / 5]).double(),
    )
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 4], [-2, 1, 0]], dtype=torch.float64)
    found = field.point_light_at(points)[:, 0]
    away = place - points
    assert_close(normalize(found, dim=1), normalize(away, dim=1))
    assert_close(found.norm(dim=1), 2.0 * 25 / away.square().sum(dim=1))
    assert_close(field.lights_at(points, normalize(points + 1, dim=1))[:, 0, 1:], found)


def test_point_lights_are_recovered(room, generator):
    points, normals, field = room
    albedo = 0.2 + torch.rand(len(points), generator=generator, dtype=torch.float64)
    J = seen_by(field, points, normals, albedo)
    seen = torch.rand(J.shape, generator=generator) > 0.4
    found = fit_light_field(torch.where(seen, J, torch.nan), seen, normals, points, iterations=150)
    scale = field.point_light[0].norm() / found.point_light[0].norm()
    assert_close(found.point_light * scale, field.point_light, rtol=1e-3, atol=1e-3)
    assert_close(found.soft * scale, field.soft, rtol=1e-3, atol=1e-3)
    assert_close(found.inverse_distance, field.inverse_distance, rtol=1e-3, atol=1e-3)


def test_point_lights_survive_cast_shadows_and_highlights(room, generator):
    points, normals, field = room
    albedo = 0.2 + torch.rand(len(points), generator=generator, dtype=torch.float64)
    J = seen_by(field, points, normals, albedo)
    draw = torch.rand(J.shape, generator=generator)
    J = torch.where(draw < 0.15, 0.1 * albedo[:, None], torch.where(draw > 0.95, 2.0, J))
    found = fit_light_field(J, torch.ones_like(draw, dtype=torch.bool), normals, points)
    cosine = (normalize(found.point_light, dim=1) * normalize(field.point_light, dim=1)).sum(dim=1)
    assert torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).max() < 2
    assert (found.inverse_distance / field.inverse_distance - 1).abs().max() < 0.1


def test_soft_light_is_not_mistaken_for_a_point_light(room, generator):
    points, normals, _ = room
    soft = torch.cat([torch.ones(6, 1), 0.5 * torch.randn(6, 3, generator=generator)], dim=1)
    soft = soft.double()
    albedo = 0.2 + torch.rand(len(points), generator=generator, dtype=torch.float64)
    basis = torch.cat([torch.ones_like(normals[:, :1]), normals], dim=1)
    J = albedo[:, None] * (basis @ soft.mT)
    found = fit_light_field(J, J > 0, normals, points)
    assert (found.point_light == 0).all()
    assert_close(found.soft[:, :4] / found.soft[:1, :1], soft / soft[:1, :1], rtol=1e-4, atol=1e-4)
    assert (found.soft[:, 4:] == 0).all()
    asked = fit_light_field(J, J > 0, normals, points, model="point_light")
    assert (asked.point_light.norm(dim=1) > 0).all()


def test_static_soft_light_is_separated_from_a_moving_point_light(room, generator):
    points, normals, field = room
    exposure = torch.linspace(0.8, 1.3, 6).double()[:, None]
    shape = torch.tensor([1.0, -0.6, 0.3, 0.2, 0.1, -0.1, 0.2, 0.1, -0.05]).double()
    field = field.replace(soft=0.3 * exposure * shape)
    albedo = 0.2 + torch.rand(len(points), generator=generator, dtype=torch.float64)
    basis = torch.cat([harmonics(normals), second_harmonics(normals)], dim=1)
    direct = (field.point_light_at(points) * normals[:, None]).sum(dim=-1).clamp_min(0)
    J = albedo[:, None] * (basis @ field.soft.mT + direct)
    seen = torch.rand(J.shape, generator=generator) > 0.3
    found = fit_light_field(torch.where(seen, J, torch.nan), seen, normals, points)

    def off(field):
        cosine = (normalize(field.point_light, dim=1) * lamps).sum(dim=1)
        return torch.rad2deg(cosine.clamp(-1, 1).acos()).max()

    lamps = normalize(field.point_light, dim=1)
    assert off(found) < 0.1
    assert off(fit_light_field(J, seen, normals, points, model="point_light")) > 2
    one = found.soft / found.soft[:, :1]
    assert_close(one, one[:1].expand(6, 9))  # one shape for all views, scaled by exposure
    assert_close(one[0, 1:3], shape[1:3], rtol=0, atol=0.15)  # albedo cannot mimic these


def test_linearized_soft_light_has_value_and_slope_at_the_normal(generator):
    normals = normalize(torch.randn(5, 3, generator=generator, dtype=torch.float64), dim=1)
    lights = torch.randn(7, 9, generator=generator, dtype=torch.float64)
    found = linearized(lights, normals)

    def error(turned):
        basis = torch.cat([harmonics(turned), second_harmonics(turned)], dim=1)
        return (found * harmonics(turned)[:, None]).sum(dim=-1) - basis @ lights.mT

    assert error(normals).abs().max() < 1e-12
    aside = normalize(normals + 1e-4 * torch.ones(3).double(), dim=1)
    assert error(aside).abs().max() < 1e-6  # 1e-8 times twice the coefficients


def test_normals_facing_away_from_the_point_light_are_unlit():
    point_light = torch.tensor([[[0.0, 0, -2], [0, 0, 0]]])
    normals = torch.tensor([[[0.0, 0, -1], [0, 0, 1], [1, 0, 0]]])
    assert faces_light(point_light, normals).tolist() == [
        [[True, False, False], [True, True, True]]
    ]


def test_a_field_without_data_is_dark():
    none = torch.zeros(0, 5)
    found = fit_light_field(none, none.bool(), torch.zeros(0, 3), torch.zeros(0, 3))
    assert (found.lights_at(torch.zeros(2, 3), torch.ones(2, 3)) == 0).all()
    unseen = fit_light_field(
        torch.full((4, 5), torch.nan), torch.zeros(4, 5).bool(), torch.ones(4, 3), torch.ones(4, 3)
    )
    assert (unseen.soft == 0).all()


@pytest.mark.parametrize("contrast", [0.3, 0.9])
def test_point_lights_are_recovered_despite_cast_shadows(generator, contrast):
    # The visible part of a ball under lights from all sides; a wall shadows a fifth of each view.
    def unit(rows):
        return normalize(torch.tensor(rows, dtype=torch.float64), dim=-1)

    normals = normalize(torch.randn(1200, 3, generator=generator, dtype=torch.float64), dim=1)
    normals = normals[normals @ unit([0.0, -0.8, 0.6]) > 0.2]
    around = [[0.67, -0.43, 0.45], [-0.06, -0.79, -0.15], [-0.54, -0.35, 0.51], [0.01, 0.36, 0.89]]
    beside = [[0.48, -0.42, 0.58], [0.02, -0.63, 0.0], [-0.08, 0.18, 0.94], [0.87, -0.16, 0.42]]
    directions = unit(around + beside)
    wall = normalize(torch.linalg.cross(directions, unit([0.0, 0, 1]).expand_as(directions)), dim=1)
    lit = torch.where(normals @ wall.mT > 0.6, 0, (normals @ directions.mT).clamp_min(0))
    albedo = 1 - contrast * torch.rand(len(normals), generator=generator, dtype=torch.float64)
    radiance = albedo[:, None] * (0.1 + lit)
    seen = torch.ones_like(radiance, dtype=torch.bool)
    field = fit_light_field(radiance, seen, normals, normals, model="point_light")
    off = (normalize(field.point_light, dim=1) * directions).sum(dim=1).clamp(-1, 1).acos()
    assert torch.rad2deg(off).max() < 1
    ambient = field.soft[:, 0] / field.point_light.norm(dim=1)
    assert_close(ambient, torch.full((8,), 0.1).double(), rtol=0.05, atol=0)


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
