import numpy as np
import pytest
import torch
from torch.testing import assert_close

from pimper_torch.kernels.robust_scale import robust_variance as compiled_variance
from pimper_torch.linalg.robust import robust_variance


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_scale_of_residuals_matches_the_reference_from_any_start(kind):
    generator = torch.Generator().manual_seed(4)
    for count, outliers in ((5, 0.0), (400, 0.3), (3000, 0.45)):
        gross = torch.rand(count, generator=generator) < outliers
        noise = torch.randn(count, generator=generator) * torch.where(gross, 50.0, 0.02)
        squares = noise.square()
        expected = float(robust_variance(squares.double(), torch.ones(count, dtype=torch.bool)))
        for guess in (0.0, 1e-6, 1.0, 1e4):
            found, _ = compiled_variance(squares.numpy(), guess, kind)
            assert_close(found, expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_scale_is_zero_if_half_of_the_residuals_are(kind):
    for squares in (torch.zeros(0), torch.zeros(5), torch.tensor([0.0, 1, 0, 1])):
        assert compiled_variance(squares.numpy(), 0.0, kind)[0] == 0
    assert compiled_variance(torch.tensor([0.0, 1, 1]).numpy(), 0.0, kind)[0] > 0
