import pytest
import torch
from draws import uniform
from torch.testing import assert_close

from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.photometric_stereo.regress_lights import (
    calibrated_stereo,
    chromatic_albedo,
    determined,
    factorize_photographs,
    regress,
)
from tests.single_view.scenes import BUMPY, angles_deg, strong_lights

COLOURS = torch.tensor([0.9, 0.5, 0.2], dtype=torch.float64)


def test_plain_regression_is_weighted_least_squares(generator):
    lights, radiance = torch.randn(8, 8, generator=generator, dtype=torch.float64).split([3, 5], 1)
    weight = uniform(generator, 8, 5)
    found = regress(radiance, weight, lights, robust=False).shading
    root = weight.mT[..., None].sqrt()
    dense = torch.linalg.lstsq(root * lights, root * radiance.mT[..., None]).solution
    assert_close(found.mT, dense[..., 0])


@pytest.mark.parametrize("robust", [False, True])
def test_samples_without_weight_are_ignored_even_if_nan(generator, robust):
    lights = uniform(generator, 8, 3)
    radiance = lights @ uniform(generator, 3, 20)
    weight, spoilt = torch.ones_like(radiance), radiance.clone()
    weight[2:4] = 0
    spoilt[2], spoilt[3] = torch.nan, 1e9
    assert_close(lights @ regress(spoilt, weight, lights, robust=robust).shading, radiance)


def test_shadows_and_highlights_lose_their_weight(generator):
    lights = strong_lights(generator, 16, spread=1.5)
    exact = lights @ BUMPY.columns
    assert (exact < 0).double().mean() > 0.05  # there are attached shadows
    draw = uniform(generator, *exact.shape)
    radiance = torch.where(draw < 0.08, 0, exact.clamp_min(0))  # cast shadows
    radiance = torch.where(draw > 0.95, radiance + 0.7, radiance)  # highlights
    weight = torch.ones_like(radiance)
    plain = regress(radiance, weight, lights, robust=False)
    robust = regress(radiance, weight, lights)
    assert angles_deg(plain.shading, BUMPY.columns).median() > 5
    off = angles_deg(robust.shading, BUMPY.columns)
    assert off.median() < 1e-3
    assert off.quantile(0.95) < 2  # a few pixels have more outliers than samples
    inliers = robust.weight[(exact > 0) & (draw < 0.95)]
    assert robust.weight[draw > 0.95].mean() < 0.2 * inliers.mean()


def test_lights_from_behind_do_not_count(generator):
    lights = strong_lights(generator, 16, spread=1.5)
    radiance = (lights @ BUMPY.columns).clamp_min(0)
    found = regress(radiance, torch.ones_like(radiance), lights)
    reliable = determined(found.weight, lights)
    assert angles_deg(found.shading, BUMPY.columns)[reliable].max() < 0.1
    assert (found.weight[radiance == 0] == 0).all()


def test_pixels_are_determined_by_enough_samples_of_lights_that_span():
    lights = torch.tensor([[0.0, 0, -1], [0.6, 0, -0.8], [-0.6, 0, -0.8], [0, 0.6, -0.8]])
    weight = torch.tensor([[1.0, 1, 1, 1], [1, 1, 1, 0.01], [1, 1, 0, 1], [1, 0, 0, 0.01]])
    # The lights of the second are in a plane.
    assert determined(weight, lights).tolist() == [True, False, False, False]


def in_span(found, true):
    """Return the part of the true columns outside the span of the found ones."""
    left = torch.linalg.qr(found).Q
    return (true - left @ (left.mT @ true)).norm() / true.norm()


def test_without_holes_the_factorization_is_the_svd(generator):
    radiance = uniform(generator, 9, 50)
    found = factorize_photographs(radiance, torch.ones_like(radiance), 3, robust=False)
    U, S, Vh = torch.linalg.svd(radiance, full_matrices=False)
    assert_close(found.lights @ found.shading, (U[:, :3] * S[:3]) @ Vh[:3])
    assert_close(found.lights.mT @ found.lights, torch.eye(3, dtype=torch.float64))


@pytest.mark.parametrize("robust", [False, True])
def test_holes_are_filled_from_the_remaining_entries(generator, robust):
    lights = strong_lights(generator, 14, spread=0.2)
    radiance = lights @ (BUMPY.patchwork * BUMPY.columns)
    weight = ((uniform(generator, *radiance.shape) > 0.4) & (radiance > 0)).double()
    spoilt = torch.where(weight > 0, radiance, torch.nan)
    found = factorize_photographs(spoilt, weight, 3, robust=robust)
    assert in_span(found.lights, lights) < 1e-5
    enough = weight.sum(dim=0) > 4
    assert_close((found.lights @ found.shading)[:, enough], radiance[:, enough], atol=1e-4, rtol=0)


def test_shadows_do_not_bias_the_lights(generator):
    lights = strong_lights(generator, 20, spread=1.3)
    radiance = (lights @ BUMPY.columns).clamp_min(0)
    radiance = torch.where(uniform(generator, *radiance.shape) < 0.07, 0, radiance)
    weight = torch.ones_like(radiance)
    plain = factorize_photographs(radiance, weight, 3, robust=False)
    off = in_span(factorize_photographs(radiance, weight, 3).lights, lights)
    assert off < 1e-3
    assert in_span(plain.lights, lights) > 10 * off


@pytest.mark.parametrize(
    ("seen", "pixels", "found"), [(2, 40, "2 views have samples"), (5, 2, "2 pixels more than 3")]
)
def test_fewer_views_or_pixels_than_the_rank_are_rejected(generator, seen, pixels, found):
    radiance = uniform(generator, 5, pixels)
    weight = torch.ones_like(radiance)
    weight[seen:] = 0
    with pytest.raises(InputError, match=found):
        factorize_photographs(radiance, weight, 3)


@pytest.mark.parametrize("robust", [False, True])
def test_colours_share_their_normal(generator, robust):
    lights = 1.7 * strong_lights(generator, 12, spread=0.3)
    albedo = COLOURS[:, None] * BUMPY.patchwork
    shade = lights @ BUMPY.columns
    lit = (shade > 0).all(dim=0)
    radiance = shade[:, None] * albedo
    found = calibrated_stereo(radiance, torch.ones_like(shade), lights, robust=robust)
    assert angles_deg(found.normals, BUMPY.columns)[lit].max() < 1e-4
    assert_close(found.albedo[:, lit], albedo[:, lit])


def test_the_brightest_channel_has_most_weight(generator):
    lights = strong_lights(generator, 12, spread=0.3)
    albedo = torch.tensor([0.9, 0.05, 0.05], dtype=torch.float64)[:, None]
    shade = lights @ BUMPY.columns
    noise = torch.randn(12, 3, shade.shape[1], generator=generator, dtype=torch.float64)
    radiance = shade[:, None] * albedo + 0.02 * noise
    weight = torch.ones_like(shade)
    together = calibrated_stereo(radiance, weight, lights, robust=False)
    of_gray = calibrated_stereo(radiance.mean(dim=1, keepdim=True), weight, lights, robust=False)
    off = angles_deg(together.normals, BUMPY.columns).mean()
    assert off < 0.7 * angles_deg(of_gray.normals, BUMPY.columns).mean()


def test_a_black_pixel_has_no_normal(generator):
    black, weight = torch.zeros(5, 3, 2, dtype=torch.float64), torch.ones(5, 2).double()
    found = calibrated_stereo(black, weight, strong_lights(generator, 5))
    assert (found.normals == 0).all()
    assert (found.albedo == 0).all()


def test_chromatic_albedo_is_that_of_least_squares(generator):
    shade, weight = uniform(generator, 2, 9, 4)
    radiance = uniform(generator, 9, 2, 4)
    found = chromatic_albedo(radiance, weight, shade)
    left = radiance - found * shade[:, None]
    assert_close(((weight * shade)[:, None] * left).sum(dim=0), torch.zeros(2, 4).double())
    assert (chromatic_albedo(-radiance, weight, shade) == 0).all()
