import math

import pytest
import torch
from draws import normal
from torch.testing import assert_close

from pimper_torch.linalg.robust import (
    Cauchy,
    GemanMcClure,
    Huber,
    Squares,
    median_deviation,
    robust_deviation,
)
from pimper_torch.runtime.errors import ConfigError


def test_the_spread_solves_its_equation(generator):
    noise = normal(generator, 2, 300)
    everything = torch.ones_like(noise, dtype=torch.bool)
    scale = 0.6472404 * robust_deviation(noise, everything)[:, None]
    fraction = noise**4 / (noise**4 + scale**4)
    assert_close(fraction.mean(dim=1), torch.full((2,), 0.5, dtype=torch.float64))


def test_the_spread_tolerates_40_percent_outliers(generator):
    noise = normal(generator, 20_000)
    noise[:8_000] *= 1e8
    found = robust_deviation(noise, torch.ones_like(noise, dtype=torch.bool))
    # 8 of 20 are beyond any scale: the median absolute value gives 2.05.
    assert 1 < found < 3


def test_the_spread_of_exact_or_missing_data_is_zero():
    residual = torch.zeros(2, 9)
    residual[0, :4] = 1
    seen = torch.tensor([[True], [False]]).expand(2, 9)
    assert_close(robust_deviation(residual, seen), torch.zeros(2))


def test_gradients_of_the_spread_match_differences(generator):
    noise = normal(generator, 2, 30).requires_grad_()
    seen = torch.rand(2, 30, generator=generator) > 0.2
    assert torch.autograd.gradcheck(lambda residual: robust_deviation(residual, seen), noise)


# Names of the losses in SciPy and ours; None: SciPy lacks it.
LOSSES = {"linear": Squares(), "cauchy": Cauchy(), "huber": Huber(), None: GemanMcClure()}


def huber(square):
    return torch.where(square <= 1, square, 2 * square.sqrt() - 1)


@pytest.mark.parametrize(
    ("loss", "rho"),
    [
        (Squares(), lambda square: square),
        (Cauchy(), torch.log1p),
        (Huber(), huber),
        (GemanMcClure(), lambda square: square / (1 + square)),
    ],
)
def test_weights_and_curvatures_are_derivatives_of_the_loss(generator, loss, rho):
    residual = normal(generator, 60).requires_grad_()
    deviation = torch.tensor(0.4, dtype=torch.float64)
    width = loss.scale * deviation
    value = (width**2 / 2 * rho((residual / width) ** 2)).sum()
    (slope,) = torch.autograd.grad(value, residual, create_graph=True)
    assert_close(slope, loss.weights(residual, deviation) * residual)
    (bend,) = torch.autograd.grad(slope.sum(), residual)
    assert_close(bend, loss.curvatures(residual.detach(), deviation))


@pytest.mark.parametrize("loss", [Squares, Cauchy, Huber, GemanMcClure])
def test_scales_are_positive(loss):
    with pytest.raises(ConfigError, match="scale"):
        loss(-1.0)


@pytest.mark.parametrize("loss", [Cauchy(), Huber(), GemanMcClure()])
def test_each_loss_is_95_percent_efficient_on_gaussian_noise(loss):
    x = torch.linspace(-9, 9, 20_001, dtype=torch.float64)
    density = torch.exp(-0.5 * x.square()) / math.sqrt(2 * math.pi) * (x[1] - x[0])
    one = torch.ones((), dtype=torch.float64)
    bend, slope = loss.curvatures(x, one), loss.weights(x, one) * x
    efficiency = (bend * density).sum() ** 2 / (slope.square() * density).sum()
    assert efficiency == pytest.approx(0.95, abs=2e-4)  # scales have four digits


def test_the_median_deviation_of_gaussian_noise_is_its_standard_deviation(generator):
    noise = 3 * normal(generator, 200_000)
    seen = torch.rand(200_000, generator=generator) > 0.3
    found = median_deviation(torch.where(seen, noise, 1e6), seen)
    assert_close(found, torch.tensor(3.0, dtype=torch.float64), rtol=0.01, atol=0)
    assert median_deviation(noise, torch.zeros_like(seen)) == 0


def test_unseen_samples_do_not_affect_the_spread(generator):
    noise = normal(generator, 3, 400)
    seen = torch.rand(3, 400, generator=generator) > 0.2
    found = robust_deviation(torch.where(seen, noise, 1e6), seen)
    assert_close(found, robust_deviation(noise, seen))
