import torch
from torch.testing import assert_close

from pimper_torch.single_view.photometric_stereo.regress_lights import determined, regress


def test_plain_regression_is_weighted_least_squares(generator):
    lights = torch.randn(8, 3, generator=generator, dtype=torch.float64)
    radiance = torch.randn(8, 5, generator=generator, dtype=torch.float64)
    weight = torch.rand(8, 5, generator=generator, dtype=torch.float64)
    found = regress(radiance, weight, lights, robust=False).shading
    for pixel in range(5):
        root = weight[:, pixel, None].sqrt()
        dense = torch.linalg.lstsq(root * lights, root * radiance[:, pixel, None]).solution
        assert_close(found[:, pixel], dense[:, 0])


def test_what_has_no_weight_does_not_matter_not_even_when_it_is_no_number(generator):
    lights = torch.rand(8, 3, generator=generator, dtype=torch.float64)
    radiance = lights @ torch.rand(3, 20, generator=generator, dtype=torch.float64)
    weight = torch.ones_like(radiance)
    weight[2:4] = 0
    spoilt = radiance.clone()
    spoilt[2] = torch.nan
    spoilt[3] = 1e9
    for robust in (False, True):
        found = regress(spoilt, weight, lights, robust=robust).shading
        assert_close(lights @ found, radiance)


def test_shadows_and_highlights_lose_their_weight(bumpy, point_lights, generator, angles_deg):
    lights = point_lights(16, spread=1.5)
    exact = lights @ bumpy.columns
    assert (exact < 0).double().mean() > 0.05  # attached shadows there are
    radiance = exact.clamp_min(0)
    draw = torch.rand(radiance.shape, generator=generator, dtype=torch.float64)
    radiance = torch.where(draw < 0.08, 0, radiance)  # cast shadows
    radiance = torch.where(draw > 0.95, radiance + 0.7, radiance)  # highlights
    weight = torch.ones_like(radiance)
    plain = regress(radiance, weight, lights, robust=False)
    robust = regress(radiance, weight, lights)
    assert angles_deg(plain.shading, bumpy.columns).median() > 5
    off = angles_deg(robust.shading, bumpy.columns)
    assert off.median() < 1e-3
    assert off.quantile(0.95) < 2  # a few pixels have more outliers than samples
    assert (
        robust.weight[draw > 0.95].mean() < 0.2 * robust.weight[(exact > 0) & (draw < 0.95)].mean()
    )


def test_lights_from_behind_are_no_measurements(bumpy, point_lights, angles_deg):
    lights = point_lights(16, spread=1.5)
    radiance = (lights @ bumpy.columns).clamp_min(0)
    found = regress(radiance, torch.ones_like(radiance), lights)
    enough, spanned = determined(found.weight, lights)
    assert angles_deg(found.shading, bumpy.columns)[enough & spanned].max() < 0.1
    assert (found.weight[radiance == 0] == 0).all()


def test_pixels_are_determined_by_enough_samples_of_lights_that_span():
    lights = torch.tensor([[0.0, 0, -1], [0.6, 0, -0.8], [-0.6, 0, -0.8], [0, 0.6, -0.8]])
    weight = torch.tensor([[1.0, 1, 1, 1], [1, 1, 1, 0.01], [1, 1, 0, 1], [1, 0, 0, 0.01]])
    enough, spanned = determined(weight, lights)
    assert enough.tolist() == [True, True, False, False]
    assert spanned.tolist()[:3] == [True, False, False]  # the second has lights in a plane
