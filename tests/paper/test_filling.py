import pytest
import torch
from torch.testing import assert_close

from pimper_torch.paper.integrate import fill_smoothly


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(6311)


def test_what_is_known_is_kept_and_what_is_not_is_never_looked_at(generator):
    weight = (torch.rand(2, 9, 14, generator=generator) < 0.3).double()
    values = torch.randn(2, 3, 9, 14, generator=generator, dtype=torch.float64)
    holed = torch.where(weight[:, None] > 0, values, torch.nan)
    filled = fill_smoothly(holed, weight)
    assert filled.isfinite().all()
    known = (weight[:, None] > 0).expand_as(values)
    assert_close(filled[known], values[known])


def test_a_constant_spreads_everywhere_from_a_single_sample():
    weight = torch.zeros(1, 11, 6, dtype=torch.float64)
    weight[0, 7, 1] = 1
    filled = fill_smoothly(torch.full((1, 2, 11, 6), 0.7, dtype=torch.float64), weight)
    assert_close(filled, torch.full_like(filled, 0.7))


def test_fillings_stay_between_their_neighbours_and_follow_the_near_side():
    values = torch.zeros(1, 1, 16, 16, dtype=torch.float64)
    values[..., 12:] = 1
    weight = torch.zeros(1, 16, 16, dtype=torch.float64)
    weight[:, :, :4] = 1
    weight[:, :, 12:] = 1
    filled = fill_smoothly(values, weight)[0, 0, 8]
    assert ((filled >= 0) & (filled <= 1)).all()
    assert filled[5] < 0.3
    assert filled[10] > 0.7
    assert (filled.diff() >= 0).all()


def test_a_patch_that_knows_nothing_is_zero():
    filled = fill_smoothly(torch.full((1, 2, 5, 5), torch.nan), torch.zeros(1, 5, 5))
    assert_close(filled, torch.zeros(1, 2, 5, 5))
