import torch
from torch.testing import assert_close

from pimper_torch.photometry.robust import Cauchy, median_deviation, robust_deviation


def drawn(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def test_the_spread_solves_its_equation(generator):
    noise = drawn(generator, 2, 300)
    everything = torch.ones_like(noise, dtype=torch.bool)
    scale = 0.6472404 * robust_deviation(noise, everything)[:, None]
    fraction = noise**4 / (noise**4 + scale**4)
    assert_close(fraction.mean(dim=1), torch.full((2,), 0.5, dtype=torch.float64))


def test_outliers_up_to_a_half_are_borne(generator):
    noise = drawn(generator, 20_000)
    noise[:8_000] *= 1e8
    found = robust_deviation(noise, torch.ones_like(noise, dtype=torch.bool))
    # 8 in 20 of them lie beyond any scale: the median absolute value gives 2.05.
    assert 1 < found < 3


def test_the_spread_of_exact_data_and_of_nothing_is_zero():
    residual = torch.zeros(2, 9)
    residual[0, :4] = 1
    seen = torch.tensor([[True], [False]]).expand(2, 9)
    assert_close(robust_deviation(residual, seen), torch.zeros(2))


def test_the_spread_has_the_gradient_of_its_differences(generator):
    noise = drawn(generator, 2, 30).requires_grad_()
    seen = torch.rand(2, 30, generator=generator) > 0.2
    assert torch.autograd.gradcheck(lambda residual: robust_deviation(residual, seen), noise)


def test_weights_and_curvatures_are_derivatives_of_the_loss(generator):
    residual = drawn(generator, 60).requires_grad_()
    deviation = torch.tensor(0.4, dtype=torch.float64)
    loss = Cauchy()
    width = loss.scale * deviation
    value = (width**2 / 2 * torch.log1p((residual / width) ** 2)).sum()
    (slope,) = torch.autograd.grad(value, residual, create_graph=True)
    assert_close(slope, loss.weights(residual, deviation) * residual)
    (bend,) = torch.autograd.grad(slope.sum(), residual)
    assert_close(bend, loss.curvatures(residual.detach(), deviation))
    assert (bend < 0).any()  # of outliers


def test_the_median_deviation_of_gaussian_noise_is_its_standard_deviation(generator):
    noise = 3 * drawn(generator, 200_000)
    seen = torch.rand(200_000, generator=generator) > 0.3
    found = median_deviation(torch.where(seen, noise, 1e6), seen)
    assert_close(found, torch.tensor(3.0, dtype=torch.float64), rtol=0.01, atol=0)
    assert median_deviation(noise, torch.zeros_like(seen)) == 0


def test_the_spread_scales_with_the_residuals(generator):
    noise = drawn(generator, 3, 400)
    seen = torch.rand(3, 400, generator=generator) > 0.2
    once = robust_deviation(noise, seen)
    assert_close(robust_deviation(7 * noise, seen), 7 * once)
    # What is not seen does not matter.
    assert_close(robust_deviation(torch.where(seen, noise, 1e6), seen), once)
