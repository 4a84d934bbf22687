import torch
from torch.testing import assert_close

from pimper_torch.photometry.spectral import factorize_rank_four


def test_data_of_lower_rank_but_for_its_rounding_is_factorized_without_blowing_up(generator):
    # A flat patch: lights times albedo, and a trace of relief that float32 hardly shows.
    lights = torch.rand(3, 9, 4, generator=generator)
    shading = torch.rand(3, 1, 600, generator=generator) + 0.2
    traces = 1e-4 * torch.randn(3, 3, 600, generator=generator)
    radiance = lights @ torch.cat([shading, traces], dim=1)
    weight = (torch.rand(3, 9, 600, generator=generator) > 0.2).float()
    L, N = factorize_rank_four(radiance, weight)
    assert L.abs().max() < 100
    assert N.abs().max() < 100
    assert_close(weight * (L @ N), weight * radiance, atol=1e-3, rtol=0)
