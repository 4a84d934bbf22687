import pytest
import torch
from torch.testing import assert_close

from pimper_torch.stages.sweep.windows import flat_weight, window_mean, window_size


@pytest.mark.parametrize("radius", [1.5, 2.5])
def test_noise_falls_by_the_size_of_the_window(generator, radius):
    noise = torch.randn(40, 1, 64, 64, generator=generator, dtype=torch.float64)
    mean = window_mean(noise, torch.ones(40, 64, 64, dtype=torch.float64), radius)
    inner = mean[..., 10:-10, 10:-10]
    assert abs(float(inner.square().mean()) * window_size(radius) - 1) < 0.06


def test_windows_end_at_a_cliff_and_not_on_a_slope():
    x = torch.arange(10.0)
    gentle = (2.0 * x).expand(1, 6, 10)
    spacing = torch.ones(1)
    swept = torch.ones(1, 6, 10)
    assert (flat_weight(gentle, swept, spacing, 4.0) == 1).all()
    cliff = gentle + 9.0 * (x >= 5)
    weight = flat_weight(cliff, swept, spacing, 4.0)
    assert (weight[..., 4:6] == 0).all()
    assert (weight[..., :4] == 1).all()
    assert (weight[..., 6:] == 1).all()
    assert_close(flat_weight(cliff.mT, swept.mT, spacing, 4.0), weight.mT)
    assert_close(flat_weight(3 * cliff, swept, 3 * spacing, 4.0), weight)  # depends on slope
