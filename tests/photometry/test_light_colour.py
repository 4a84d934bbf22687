import pytest
import torch
from torch.testing import assert_close

from pimper_torch.lighting.light_colour import exposures, light_colours


def scene(generator, views=8, samples=900):
    """Return radiance, visibility and colour factors; each view sees a third, as on an arc."""
    albedo = 0.2 + 0.6 * torch.rand(samples, 1, 3, generator=generator, dtype=torch.float64)
    shading = 0.3 + torch.rand(samples, views, 1, generator=generator, dtype=torch.float64)
    colour = (0.3 * torch.randn(views, 3, generator=generator, dtype=torch.float64)).exp()
    place = torch.arange(samples)[:, None] / samples
    seen = (place - torch.arange(views) / (views - 1)).abs() < 0.33
    return albedo * shading, seen, colour


def test_colours_are_recovered_up_to_albedo_under_any_shading(generator):
    white, seen, colour = scene(generator)
    found = light_colours(torch.where(seen[..., None], white * colour, torch.nan), seen)
    ratio = (found / colour).log()
    ratio = ratio - ratio.mean(dim=1, keepdim=True)  # brightness belongs to the light
    assert_close(ratio, ratio.mean(dim=0).expand(8, 3), rtol=0, atol=2e-3)
    common = found.log().mean(dim=0)
    assert_close(common, common.mean().expand(3))


def test_colours_do_not_change_mean_brightness(generator):
    white, seen, colour = scene(generator)
    seen = torch.ones_like(seen)
    tinted = white * colour
    found = light_colours(tinted, seen)
    before, after = tinted.mean(dim=2).mean(dim=0), (tinted / found).mean(dim=2).mean(dim=0)
    assert_close(before, after, rtol=0.02, atol=0)  # for the mean albedo, not that of each view


def test_shared_light_colour_is_white_despite_noise(generator):
    white, seen, colour = scene(generator)
    noise = 0.05 * torch.randn(white.shape, generator=generator, dtype=torch.float64)
    found = light_colours(white * (1 + noise) * colour[:1], seen)
    assert (found == 1).all()


def test_gross_outliers_and_black_samples_do_not_tint(generator):
    white, seen, colour = scene(generator)
    tinted = white * colour
    tinted[::7] = torch.rand(tinted[::7].shape, generator=generator).double()
    tinted[3::11] = 0
    found = light_colours(tinted, seen)
    ratio = (found / colour).log()
    ratio = ratio - ratio.mean(dim=1, keepdim=True)
    assert (ratio - ratio.mean(dim=0)).abs().max() < 0.02


@pytest.mark.parametrize("most", [0.0, 0.4])
def test_exposures_are_recovered_in_full_stops_only(generator, most):
    white, seen, _ = scene(generator)
    unlike = torch.tensor([0.0, 1, -1, 0, 2, 0, -2, 0], dtype=torch.float64)
    drawn = most * (2 * torch.rand(8, generator=generator, dtype=torch.float64) - 1)
    found = exposures(white[..., 0] * (unlike + drawn).exp2(), seen)
    assert_close(found, unlike.exp2())
    assert (exposures(white[..., 0] * drawn.exp2(), seen) == 1).all()


def test_exposures_of_unseen_views_are_one_and_dark_ones_are_bounded(generator):
    white, seen, _ = scene(generator)
    seen[:, 3] = False
    dark = torch.tensor([1.0, 1, 1, 1, 1, 2.0**-6, 1, 1], dtype=torch.float64)
    found = exposures(white[..., 0] * dark, seen)
    assert found[3] == 1
    assert found[5] == 2.0**-3
