import pytest
import torch
from torch.testing import assert_close

from pimper_torch.method.sfm.track_observations import evenly
from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.photometric_stereo.regress_lights import factorize_photographs


def in_span(found, true):
    """How much of the true columns a factorization of lights does not reach."""
    left = torch.linalg.qr(found).Q
    return (true - left @ (left.mT @ true)).norm() / true.norm()


def test_without_holes_it_is_the_singular_value_decomposition(generator):
    radiance = torch.rand(9, 50, generator=generator, dtype=torch.float64)
    found = factorize_photographs(radiance, torch.ones_like(radiance), 3, robust=False)
    U, S, Vh = torch.linalg.svd(radiance, full_matrices=False)
    assert_close(found.lights @ found.shading, (U[:, :3] * S[:3]) @ Vh[:3])
    assert_close(found.lights.mT @ found.lights, torch.eye(3, dtype=torch.float64))


@pytest.mark.parametrize("robust", [False, True])
def test_holes_are_filled_by_the_rest(bumpy, point_lights, patchwork, generator, robust):
    lights = point_lights(14, spread=0.2)
    radiance = lights @ (patchwork(bumpy) * bumpy.columns)
    weight = (torch.rand(radiance.shape, generator=generator) > 0.4).double()
    weight = weight * (radiance > 0)
    spoilt = torch.where(weight > 0, radiance, torch.nan)
    found = factorize_photographs(spoilt, weight, 3, robust=robust)
    assert in_span(found.lights, lights) < 1e-5
    enough = weight.sum(dim=0) > 4
    assert_close((found.lights @ found.shading)[:, enough], radiance[:, enough], atol=1e-4, rtol=0)


def test_shadows_do_not_disturb_the_lights(bumpy, point_lights, generator):
    lights = point_lights(20, spread=1.3)
    radiance = (lights @ bumpy.columns).clamp_min(0)
    cast = torch.rand(radiance.shape, generator=generator) < 0.07
    radiance = torch.where(cast, 0, radiance)
    weight = torch.ones_like(radiance)
    plain = factorize_photographs(radiance, weight, 3, robust=False)
    robust = factorize_photographs(radiance, weight, 3)
    off = in_span(robust.lights, lights)
    assert off < 1e-3
    assert in_span(plain.lights, lights) > 10 * off


def test_places_are_spread_evenly():
    assert evenly(5, 10).tolist() == [0, 1, 2, 3, 4]
    assert evenly(9, 3).tolist() == [0, 4, 8]


def test_fewer_views_or_pixels_than_the_rank_are_refused(generator):
    radiance = torch.rand(5, 40, generator=generator, dtype=torch.float64)
    weight = torch.ones_like(radiance)
    weight[2:] = 0
    with pytest.raises(InputError, match="2 views have samples"):
        factorize_photographs(radiance, weight, 3)
    with pytest.raises(InputError, match="2 pixels more than 3"):
        factorize_photographs(radiance[:, :2], torch.ones(5, 2, dtype=torch.float64), 3)
