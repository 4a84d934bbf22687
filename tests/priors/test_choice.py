"""When one hypothesis about data is accepted: properties of the margins."""

import torch

from pimper_torch.priors.choice import clearly_better


def test_four_standard_errors_are_significant_and_too_few_samples_are_not(generator):
    differences = torch.randn(400, generator=generator, dtype=torch.float64)
    error = (differences.var() / 400).sqrt()
    for wanted, believed in ((3.99, False), (4.01, True)):
        moved = differences - differences.mean() + wanted * error
        # Neither the unit of a score counts, nor the order of the places.
        assert clearly_better(7 * moved.flip(0), torch.zeros(400)) == believed
    assert clearly_better(torch.ones(8), torch.zeros(8))
    assert not clearly_better(torch.ones(7), torch.zeros(7))


def test_noise_is_not_significant(generator):
    one, other = torch.randn(2, 5000, generator=generator)
    assert not clearly_better(one, other)
    assert not clearly_better(other, one)
    assert clearly_better(one + 0.2, other)
