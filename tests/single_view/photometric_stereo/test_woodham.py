import pytest
import torch
from torch.testing import assert_close

from pimper_torch.single_view.photometric_stereo.regress_lights import (
    calibrated_stereo,
    chromatic_albedo,
)

COLOURS = torch.tensor([0.9, 0.5, 0.2], dtype=torch.float64)


@pytest.mark.parametrize("robust", [False, True])
def test_colours_share_their_normal(bumpy, point_lights, patchwork, angles_deg, robust):
    lights = 1.7 * point_lights(12, spread=0.3)
    albedo = COLOURS[:, None] * patchwork(bumpy)
    shade = lights @ bumpy.columns
    lit = (shade > 0).all(dim=0)
    radiance = shade[:, None] * albedo
    found = calibrated_stereo(radiance, torch.ones_like(shade), lights, robust=robust)
    assert angles_deg(found.normals, bumpy.columns)[lit].max() < 1e-4
    assert_close(found.albedo[:, lit], albedo[:, lit])


def test_the_colour_that_says_most_counts_most(bumpy, point_lights, generator, angles_deg):
    lights = point_lights(12, spread=0.3)
    albedo = torch.tensor([0.9, 0.05, 0.05], dtype=torch.float64)[:, None]
    shade = lights @ bumpy.columns
    noise = 0.02 * torch.randn(12, 3, shade.shape[1], generator=generator, dtype=torch.float64)
    radiance = shade[:, None] * albedo + noise
    weight = torch.ones_like(shade)
    together = calibrated_stereo(radiance, weight, lights, robust=False)
    of_gray = calibrated_stereo(radiance.mean(dim=1, keepdim=True), weight, lights, robust=False)
    off = angles_deg(together.normals, bumpy.columns).mean()
    assert off < 0.7 * angles_deg(of_gray.normals, bumpy.columns).mean()


def test_a_black_pixel_has_no_normal(point_lights):
    lights = point_lights(5)
    found = calibrated_stereo(
        torch.zeros(5, 3, 2, dtype=torch.float64), torch.ones(5, 2, dtype=torch.float64), lights
    )
    assert (found.normals == 0).all()
    assert (found.albedo == 0).all()


def test_albedo_is_the_best_one_for_its_shade(generator):
    shade, weight = torch.rand(2, 9, 4, generator=generator, dtype=torch.float64)
    radiance = torch.rand(9, 2, 4, generator=generator, dtype=torch.float64)
    found = chromatic_albedo(radiance, weight, shade)
    for channel in range(2):
        left = radiance[:, channel] - found[channel] * shade
        assert_close((weight * left * shade).sum(dim=0), torch.zeros(4, dtype=torch.float64))
    assert (chromatic_albedo(-radiance, weight, shade) == 0).all()
