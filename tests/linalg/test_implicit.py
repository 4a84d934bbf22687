import torch
from torch.testing import assert_close

from pimper_torch.linalg.implicit import implicit_solution, newton_solution


def coupled(x, theta):
    """Equations whose derivative by the unknowns is not symmetric."""
    return x**3 + 2 * x + 0.5 * x.roll(1) * theta.sin() - theta


def near(theta):
    return lambda side: side / (2 + 0.1 * theta.detach().abs())


def test_newton_takes_a_rough_solution_to_rounding(generator):
    theta = torch.randn(40, generator=generator, dtype=torch.float64)
    found = newton_solution(lambda x: coupled(x, theta), theta / 3, near(theta))
    assert_close(coupled(found, theta), torch.zeros_like(theta), rtol=0, atol=1e-12)


def test_gradients_are_those_of_the_solution(generator):
    theta = torch.randn(12, generator=generator, dtype=torch.float64).requires_grad_()

    def solution(theta):
        start = newton_solution(lambda x: coupled(x, theta.detach()), theta / 3, near(theta))
        return implicit_solution(lambda x: coupled(x, theta), start, near(theta))

    assert torch.autograd.gradcheck(solution, theta)


def test_a_start_that_no_step_improves_is_returned():
    start = torch.ones(3, dtype=torch.float64)
    found = newton_solution(lambda x: x.abs() + 1 + 0 * x, 0 * start, lambda side: side)
    assert_close(found, 0 * start)
