import pytest
import torch
from torch.testing import assert_close

from pimper_torch.ground.linalg.conjugate_gradients import conjugate_gradients


@pytest.fixture
def systems():
    """Three systems of unlike size and condition, one of them with the solution zero."""
    generator = torch.Generator().manual_seed(6217)
    root = torch.randn(3, 12, 12, generator=generator, dtype=torch.float64)
    scale = torch.tensor([1.0, 1e3, 1e-3]).double()[:, None, None]
    matrices = scale * (root @ root.mT + 0.1 * torch.eye(12).double())
    rhs = torch.randn(3, 12, generator=generator, dtype=torch.float64)
    rhs[1] = 0
    return matrices, rhs


def solve(matrices, rhs, **options):
    inverse = 1 / matrices.diagonal(dim1=1, dim2=2)
    return conjugate_gradients(
        lambda x: (matrices @ x[..., None])[..., 0],
        lambda x: inverse * x,
        rhs,
        **{"tolerance": 1e-12, "max_iterations": 200} | options,
    )


def test_every_system_of_a_batch_is_solved(systems):
    found, steps, converged = solve(*systems)
    assert converged
    assert 0 < steps < 200
    exact = torch.linalg.solve(*systems)
    # Of each system's own size; the second one's solution is zero.
    assert ((found - exact).norm(dim=1) <= 1e-9 * exact.norm(dim=1)).all()


def test_the_exact_preconditioner_takes_one_step(systems):
    matrices, rhs = systems
    _, steps, _ = conjugate_gradients(
        lambda x: (matrices @ x[..., None])[..., 0],
        lambda x: torch.linalg.solve(matrices, x),
        rhs,
        tolerance=1e-10,
        max_iterations=5,
    )
    assert steps == 1


def test_a_start_at_the_solution_is_kept_and_left_alone(systems):
    start = torch.linalg.solve(*systems)
    before = start.clone()
    found, steps, _ = solve(*systems, start=start, tolerance=1e-10)
    assert steps == 0
    assert_close(found, before, rtol=0, atol=0)
    solve(*systems, start=start.zero_())
    assert (start == 0).all()


def test_the_tolerance_bounds_the_error_in_the_energy_norm(systems):
    matrices, rhs = systems
    wanted = torch.linalg.solve(matrices, rhs)

    def energy(x):
        return (x[:, None] @ matrices @ x[..., None])[:, 0, 0]

    rough, few, _ = solve(matrices, rhs, tolerance=1e-3)
    _, many, _ = solve(matrices, rhs)
    assert few < many
    # The preconditioner's estimate is off by the root of the preconditioned condition at most.
    inverse = matrices.diagonal(dim1=1, dim2=2).rsqrt()
    condition = torch.linalg.cond(inverse[:, :, None] * matrices * inverse[:, None, :])
    bound = 1e-6 * condition * energy(wanted)
    assert (energy(rough - wanted) <= bound).all()
    assert (energy(rough - wanted)[[0, 2]] > 0).all()


@pytest.mark.parametrize("wrong", ["negative", "nan", "limit"])
def test_what_does_not_converge_is_said(systems, wrong):
    matrices, rhs = systems
    if wrong == "negative":
        matrices = matrices - 50 * matrices.diagonal(dim1=1, dim2=2).mean() * torch.eye(12)
    if wrong == "nan":
        rhs = rhs * torch.nan
    _, steps, converged = solve(matrices, rhs, max_iterations=2 if wrong == "limit" else 200)
    assert not converged
    assert steps < 200
