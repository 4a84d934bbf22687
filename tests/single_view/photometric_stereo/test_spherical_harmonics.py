import pytest
import torch
from torch.testing import assert_close

from pimper_torch.errors import InputError
from pimper_torch.photometry.harmonics import harmonics
from pimper_torch.single_view.factorization.ambiguity import align_factorizations, minkowski
from pimper_torch.single_view.photometric_stereo.spherical_harmonics import four_harmonic_stereo


@pytest.fixture
def soft(generator):
    """Fifteen lights of first order, bright enough that none leaves darkness."""
    lights = torch.rand(15, 4, generator=generator, dtype=torch.float64) - 0.5
    lights[:, 0] = 1.2
    lights[:, 3] -= 0.4
    return lights


def test_four_harmonics_leave_convex_or_concave_only(bumpy, soft, patchwork, generator, angles_deg):
    albedo = patchwork(bumpy)
    radiance = soft @ (albedo * harmonics(bumpy.columns.mT).mT)
    weight = torch.ones_like(radiance)
    found = four_harmonic_stereo(radiance, weight, bumpy.mask, generator)
    # Over cells of 1/56 of the surface its slopes are not quite linear.
    assert angles_deg(found.shading[1:], bumpy.columns).mean() < 0.6
    ratio = found.shading[0] / albedo
    assert ratio.std() < 0.02 * ratio.mean()
    assert_close(found.lights @ found.shading, radiance, atol=1e-6, rtol=0)
    A, eta = found.ambiguity.matrix, minkowski(found.ambiguity.matrix)
    assert_close(A.mT @ eta @ A, found.ambiguity.scale**2 * eta)


def test_highlights_lose_their_weight(bumpy, soft, generator, angles_deg):
    radiance = soft @ harmonics(bumpy.columns.mT).mT
    bright = torch.rand(radiance.shape, generator=generator) < 0.04
    radiance = torch.where(bright, radiance + 1, radiance)
    weight = torch.ones_like(radiance)
    found = four_harmonic_stereo(radiance, weight, bumpy.mask, generator, robust=True)
    assert angles_deg(found.shading[1:], bumpy.columns).mean() < 1


def test_point_lights_from_all_sides_come_near_to_four_harmonics(bumpy, angles_deg):
    # Point lights over the viewer's half ball, evenly; 20 % of the samples lie in attached shadow.
    index = torch.arange(40, dtype=torch.float64) + 0.5
    cosine, around = 1 - index / 40, index * 2.39996
    sine = (1 - cosine**2).sqrt()
    directions = torch.stack([sine * around.cos(), sine * around.sin(), -cosine], dim=1)
    radiance = (directions @ bumpy.columns).clamp_min(0)
    weight = torch.ones_like(radiance)
    found = four_harmonic_stereo(
        radiance, weight, bumpy.mask, torch.Generator().manual_seed(0)
    ).shading
    even = torch.ones_like(found[0])
    best = align_factorizations(found / found[0], harmonics(bumpy.columns.mT).mT, even)
    # First order is short of the clamped cosine by a few degrees.
    assert angles_deg(best.on_shading(found)[1:], bumpy.columns).mean() < 6


def test_fewer_views_than_harmonics_are_refused(bumpy, soft, generator):
    radiance = soft[:8] @ harmonics(bumpy.columns.mT).mT
    weight = torch.ones_like(radiance)
    with pytest.raises(InputError, match="needed: 4 views"):
        four_harmonic_stereo(radiance[:3], weight[:3], bumpy.mask, generator)
