import torch
from torch.testing import assert_close

from pimper_torch.linalg.sums import average, total
from tests.threads import on_threads


def test_a_total_has_the_same_bits_on_any_number_of_threads():
    values = torch.randn(700, 1501, generator=torch.Generator().manual_seed(1))
    sums = {float(one) for one in on_threads(lambda: total(values), 1, 2, 3, 7)}
    assert len(sums) == 1
    means = {float(one) for one in on_threads(lambda: average(values), 1, 2, 3, 7)}
    assert len(means) == 1


def test_a_total_is_the_sum_and_an_average_the_mean():
    generator = torch.Generator().manual_seed(2)
    for size in (0, 1, 4096, 4097, 20_000):
        values = torch.randn(size, generator=generator, dtype=torch.float64, requires_grad=True)
        assert_close(total(values), values.sum())
        assert_close(average(values), values.mean(), equal_nan=True)
        (gradient,) = torch.autograd.grad(total(values), values)
        assert_close(gradient, torch.ones_like(values))
