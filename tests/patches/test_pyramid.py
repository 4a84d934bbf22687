import pytest
import torch
from kornia.geometry.transform import pyrdown
from torch.testing import assert_close

from pimper_torch.geometry.pyramids import halve, look_up


@pytest.mark.parametrize("size", [(12, 20), (13, 7)])
def test_halving_equals_that_of_gaussian_pyramids(generator, size):
    images = torch.rand(2, 3, *size, generator=generator, dtype=torch.float64)
    assert_close(halve(images), pyrdown(images))


def test_a_level_between_two_is_their_blend(generator):
    fine = torch.rand(1, 8, 8, generator=generator, dtype=torch.float64)
    rough = torch.rand(1, 4, 4, generator=generator, dtype=torch.float64)
    pixels = 8 * torch.rand(50, 2, generator=generator, dtype=torch.float64)

    def at(level: float) -> torch.Tensor:
        return look_up([fine, rough], pixels, torch.full((50,), level, dtype=torch.float64))

    assert_close(at(0.25), 0.75 * at(0.0) + 0.25 * at(1.0))
    assert_close(at(7.0), at(1.0))  # no level beyond the last
    assert not torch.allclose(at(0.0), at(1.0))


def test_samples_of_several_levels_do_not_mix(generator):
    pyramid = [torch.zeros(1, 8, 8), torch.ones(1, 4, 4), 2 * torch.ones(1, 2, 2)]
    level = 2 * torch.rand(70, generator=generator)
    pixels = 8 * torch.rand(70, 2, generator=generator)
    assert_close(look_up(pyramid, pixels, level)[:, 0], level)
