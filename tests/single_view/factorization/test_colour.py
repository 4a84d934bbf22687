import pytest
import torch
from torch.testing import assert_close

from pimper_torch.photometry.variable_projection import solve_variable_projection
from pimper_torch.single_view.factorization.ambiguity import align_factorizations
from pimper_torch.single_view.factorization.colour import solve_in_colour


@pytest.fixture
def coloured(problem, generator):
    """Point lights of different colours on a surface of different colours."""
    given, lights, shading = problem(patches=2, missing=0.3)
    chroma = 0.4 + torch.rand(2, 3, 150, generator=generator, dtype=torch.float64)
    chroma = chroma / chroma.square().mean(dim=1, keepdim=True).sqrt()
    tint = 0.6 + 0.8 * torch.rand(2, 20, 3, 1, generator=generator, dtype=torch.float64)
    tinted = tint * lights[:, :, None]
    radiance = given.weight[:, :, None] * (tinted @ shading[:, None]) * chroma[:, None]
    gray = radiance.mean(dim=2)
    return given.replace(radiance=gray), radiance, tinted, shading, chroma


def normals_error(shading, truth):
    rotation = align_factorizations(shading, truth, torch.ones_like(truth[:, 0]))
    moved = rotation.on_shading(shading)[:, 1:]
    cosine = torch.nn.functional.cosine_similarity(moved, truth[:, 1:], dim=1)
    return cosine.clamp(-1, 1).acos().rad2deg().median()


@pytest.mark.slow
def test_normals_colours_and_coloured_lights_come_back(coloured):
    given, radiance, tinted, shading, chroma = coloured
    found = solve_in_colour(given, radiance, solve_variable_projection, 60, 1e-10, iterations=30)
    predicted = (found.lights @ found.shading[:, None]) * found.chroma[:, None]
    seen = given.weight[:, :, None].expand_as(radiance) > 0
    assert (predicted - radiance)[seen].abs().median() < 1e-3
    assert normals_error(found.shading, shading) < 0.5
    # Light and chroma share one free factor a channel.
    ratio = found.chroma / chroma
    ratio = ratio / ratio[:, :1]
    ratio = ratio / ratio.mean(dim=2, keepdim=True)
    # Turns of factors and chroma end slowly: a third of this is left after 100 of them.
    assert (ratio - 1).abs().median() < 0.02
    light = found.lights[:, :, :1].norm(dim=3) / tinted[:, :, :1].norm(dim=3)
    tints = found.lights.norm(dim=3) / tinted.norm(dim=3) / light
    assert ((tints / tints.mean(dim=1, keepdim=True)) - 1).abs().median() < 0.05
    alone = solve_variable_projection(given, 60, 1e-10)
    assert normals_error(alone.shading, shading) > 5 * normals_error(found.shading, shading)


def test_a_gray_surface_in_gray_light_is_the_gray_problem(problem):
    given, _, _ = problem(patches=1, missing=0.3)
    given = given.replace(regularization=torch.full_like(given.regularization, 3.0))
    three = given.radiance[:, :, None].expand(-1, -1, 3, -1)
    found = solve_in_colour(given, three, solve_variable_projection, 100, 1e-12, iterations=1)
    tripled = given.replace(weight=3 * given.weight, regularization=3 * given.regularization)
    alone = solve_variable_projection(tripled, 100, 1e-12)
    assert_close(found.chroma, torch.ones_like(found.chroma), rtol=0, atol=5e-3)
    assert_close(found.lights[:, :, 1], alone.lights, rtol=0, atol=5e-3)
    assert_close(found.shading, alone.shading, rtol=0, atol=5e-3)


@pytest.mark.slow
def test_a_channel_that_is_dark_says_nothing(coloured):
    given, radiance, _, shading, _ = coloured
    dark = radiance.clone()
    dark[:, :, 2] = 0
    found = solve_in_colour(given, dark, solve_variable_projection, 60, 1e-10, iterations=20)
    assert found.shading.isfinite().all()
    assert (found.chroma[:, 2] == 0).all()
    assert normals_error(found.shading, shading) < 1
