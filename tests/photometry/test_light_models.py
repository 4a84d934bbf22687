"""The models of a view's light against their derivatives, their bounds and the light field."""

import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.lighting.light_field import LightField, harmonics, second_harmonics
from pimper_torch.lighting.light_models import MIN_DISTANCE, LightModel


def basis(normals):
    return torch.cat([harmonics(normals), second_harmonics(normals)], dim=1)


def draw(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


@pytest.fixture
def samples(generator):
    return normalize(draw(generator, 50, 3), dim=1), 0.5 * draw(generator, 50, 3)


def lights(generator, model, views=6):
    """Return lights within all bounds; point lights are three times as far as the samples."""
    soft = draw(generator, views, model.basis.shape[1])
    soft[:, 0] = 0.1 + soft[:, 0].abs()
    if model.points is None:
        return soft
    return torch.cat([soft, draw(generator, views, 3), torch.full((views, 1), 0.3).double()], dim=1)


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
