import pytest
import torch
from reliefs import ball, bumps, regions
from torch.testing import assert_close

from pimper_torch.errors import InputError
from pimper_torch.evidence.scenes.one_view import photograph, point_lights
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.photometric_stereo.diffuse_maxima import (
    _equations,
    find_maxima,
    resolve_by_diffuse_maxima,
)

HIDDEN = BasRelief(
    mu=torch.tensor(0.7).double(), nu=torch.tensor(-0.4).double(), lam=torch.tensor(1.6).double()
)


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def error_deg(shading, normals):
    cross = torch.linalg.cross(shading, normals, dim=0).norm(dim=0)
    return torch.rad2deg(torch.atan2(cross, (shading * normals).sum(dim=0))).mean()


def grey(size):
    return 0.7 * torch.ones(size, size, 1, dtype=torch.float64)


def resolved(made, radius=3):
    b, lights = HIDDEN.on_shading(made.shading), HIDDEN.on_lights(made.lights)
    found = resolve_by_diffuse_maxima(made.images, made.mask, b, lights, radius=radius)
    return error_deg(found.on_shading(b), made.normals)


def test_equations_vanish_where_normals_point_to_their_point_lights(generator):
    n = torch.randn(3, 12, generator=generator, dtype=torch.float64)
    b, light = HIDDEN.on_shading(2 * n), HIDDEN.on_lights(3 * n.mT).mT
    relief = HIDDEN.inverse().matrix
    M = relief.mT @ relief
    metric = torch.stack([M[0, 0], M[0, 2], M[1, 2], M[2, 2]])
    equations = _equations(b, light)
    assert_close(equations @ metric, torch.zeros(12, 3).double())
    assert torch.linalg.matrix_rank(equations[:2].flatten(0, 1)) == 3  # two give the metric


def test_maxima_on_a_ball_are_where_it_faces_the_point_light(generator):
    normals, mask = ball(60)
    made = photograph(normals, grey(60), mask, point_lights(6, generator), generator)
    maxima = find_maxima(made.images, mask, made.shading)
    assert (torch.bincount(maxima.view, minlength=6) == 1).all()
    # A pixel is 1.8 degrees and more; what quadratics miss is cubic, and grows towards the rim.
    assert error_deg(maxima.shading, made.lights[maxima.view].mT) < 0.3
    side = torch.sin(torch.deg2rad(torch.tensor(75.0))).double()
    direction = torch.nn.functional.normalize(made.lights[maxima.view], dim=1)
    assert_close(maxima.pixel, 30 + 30 * direction[:, :2] / side, atol=0.4, rtol=0)


@pytest.mark.parametrize("shape", ["ball", "bumps"])
def test_the_relief_of_a_surface_of_one_paint_is_found(generator, shape):
    normals, mask = ball(64) if shape == "ball" else bumps(64, generator)
    made = photograph(normals, grey(64), mask, point_lights(10, generator), generator)
    assert resolved(made) < 0.3  # what the quadratics leave of a pixel of 2 degrees


def test_maxima_that_paint_makes_are_outvoted(generator):
    normals, mask = ball(96)
    made = photograph(normals, regions(96, generator), mask, point_lights(12, generator), generator)
    wrong = find_maxima(made.images, mask, made.shading)
    towards = made.lights[wrong.view].mT
    cross = torch.linalg.cross(wrong.shading, towards, dim=0).norm(dim=0)
    angle = torch.rad2deg(torch.atan2(cross, (wrong.shading * towards).sum(dim=0)))
    assert (angle > 3).double().mean() > 0.5
    assert resolved(made) < 0.5


def test_noise_moves_maxima_by_parts_of_a_pixel(generator):
    normals, mask = ball(64)
    made = photograph(normals, grey(64), mask, point_lights(10, generator), generator, noise=0.01)
    # Ten maxima, each some 3 degrees off.
    assert resolved(made, radius=5) < 2.5


def test_the_border_and_the_shadow_hold_no_maxima(generator):
    normals, mask = ball(64)
    wide = torch.tensor([[1.0, 0.0, -0.05], [0.0, 0.1, -1.0]], dtype=torch.float64)
    made = photograph(normals, grey(64), mask, wide, generator)
    maxima = find_maxima(made.images, mask, made.shading)
    assert maxima.view.tolist() == [1]  # the first point light is faced at the rim only


def test_what_does_not_fit_is_refused(generator):
    normals, mask = ball(40)
    made = photograph(normals, grey(40), mask, point_lights(4, generator), generator)
    b, lights = made.shading, made.lights
    with pytest.raises(InputError, match="one light a view"):
        resolve_by_diffuse_maxima(made.images, mask, b[:, 1:], lights)
    with pytest.raises(InputError, match="two at least"):
        resolve_by_diffuse_maxima(made.images[:1], mask, b, lights[:1])
    with pytest.raises(InputError, match="parallel"):
        resolve_by_diffuse_maxima(made.images, mask, b[:, :1].expand_as(b), lights)
    opposite = lights * torch.tensor([[1.0], [1.0], [-1.0], [-1.0]]).double()
    with pytest.raises(InputError, match="agree"):
        resolve_by_diffuse_maxima(made.images, mask, b, opposite.roll(1, 0))
