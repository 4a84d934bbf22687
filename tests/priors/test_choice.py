"""When one reading of data is believed: laws of the margins."""

import pytest
import torch

from pimper_torch.priors.choice import standard_errors, surely_better


def test_standard_errors_of_a_mean_are_those_of_statistics(generator):
    differences = torch.randn(400, generator=generator, dtype=torch.float64) + 0.3
    expected = differences.mean() / (differences.var() / 400).sqrt()
    assert standard_errors(differences) == pytest.approx(float(expected))
    # Neither the unit of a score counts, nor the order of the places; the sign turns round.
    assert standard_errors(7 * differences.flip(0)) == pytest.approx(float(expected))
    assert standard_errors(-differences) == pytest.approx(-float(expected))


def test_places_that_are_too_few_tell_nothing():
    assert standard_errors(torch.ones(7)) == 0
    assert surely_better(torch.ones(8), torch.zeros(8))
    assert not surely_better(torch.ones(7), torch.zeros(7))


def test_noise_alone_is_not_believed(generator):
    one, other = torch.randn(2, 5000, generator=generator)
    assert not surely_better(one, other)
    assert not surely_better(other, one)
    assert surely_better(one + 0.2, other)
