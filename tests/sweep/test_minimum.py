import math

import pytest
import torch
from torch.testing import assert_close

from pimper_torch.stages.sweep.minimum import parabola_minimum, posterior_variance


def costs(place: float, curvature: float, count: int = 9) -> torch.Tensor:
    steps = torch.arange(count, dtype=torch.float64)
    return (0.5 * curvature * (steps - place).square())[None]


def test_a_prior_selects_a_minimum_without_moving_it():
    steps = torch.arange(9, dtype=torch.float64)
    two = torch.minimum((steps - 2.2).square(), (steps - 6.1).square() + 0.05)[None]
    assert_close(parabola_minimum(two)[0], torch.tensor([2.2]).double())
    with_prior = parabola_minimum(two, 0.3 * (steps - 7.0).abs()[None])[0]
    assert_close(with_prior, torch.tensor([6.1]).double())


@pytest.mark.parametrize("deviation", [0.05, 0.3, 1.0, 3.0])
@pytest.mark.parametrize("position", [20.0, 20.3, 19.5])
def test_the_variance_of_gaussian_costs_is_exact(deviation, position):
    cost = costs(position, deviation**-2, count=41)
    found, curvature, _ = parabola_minimum(cost)
    variance = posterior_variance(cost, found, curvature)
    assert_close(variance, torch.tensor([deviation**2], dtype=torch.float64))


def test_tails_heavier_than_the_parabola_add_to_the_variance():
    steps = torch.arange(401, dtype=torch.float64)
    cost = 3 * torch.log1p(((steps - 200) / 20).square())[None]  # Student's t of 5 degrees
    variance = posterior_variance(cost, *parabola_minimum(cost)[:2])
    # For t with nu degrees and scale s = 20 / nu^(1/2): s^2 nu / (nu - 2); cut at 10 scales.
    assert_close(variance, torch.tensor([400 / 3], dtype=torch.float64), rtol=0.02, atol=0)


def test_two_equal_minima_raise_the_variance():
    one = torch.full((1, 9), 50.0, dtype=torch.float64)
    one[0, 2] = 0
    two = one.clone()
    two[0, 7] = 1e-3
    alone = posterior_variance(one, *parabola_minimum(one)[:2])
    torn = posterior_variance(two, *parabola_minimum(two)[:2])
    assert float(alone) < 0.1
    assert math.isclose(float(torn), 2.5**2 + 0.01, rel_tol=0.01)
