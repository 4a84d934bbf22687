import pytest
import torch
from torch.testing import assert_close

from pimper_torch.errors import InputError
from pimper_torch.photometry.low_rank import LowRank, random_left, solve_right
from pimper_torch.photometry.restarts import factorize_from_many
from pimper_torch.photometry.variable_projection import (
    _equations,
    solve_variable_projection,
)


@pytest.fixture
def product(generator):
    """Products of rank three, a part of them missing."""

    def make(rows=12, columns=60, rank=3, batch=2, missing=0.3, noise=0.0):
        def draw(*shape):
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        X = draw(batch, rows, rank) @ draw(batch, rank, columns)
        X = X + noise * draw(*X.shape)
        seen = torch.rand(X.shape, generator=generator) >= missing
        seen[:, : rank + 2] = True  # every column determines its coefficients
        return torch.where(seen, X, torch.nan), seen.double(), X

    return make


def test_missing_entries_come_back(product, generator):
    X, weight, whole = product()
    found = solve_variable_projection(X, weight, random_left(2, 12, 3, generator))
    assert_close(found.left @ found.right, whole, rtol=1e-5, atol=1e-5)
    assert (found.convergence.residual < 1e-6).all()
    assert found.convergence.converged.all()
    assert_close(found.left.mT @ found.left, torch.eye(3).double().expand(2, 3, 3))


def test_matrices_of_a_batch_do_not_influence_one_another(product, generator):
    X, weight, _ = product(noise=0.1)
    start = random_left(2, 12, 3, generator)
    both = solve_variable_projection(X, weight, start)
    alone = solve_variable_projection(X[1:], weight[1:], start[1:])
    assert_close(both.convergence.residual[1:], alone.convergence.residual)
    assert_close((both.left @ both.right)[1:], alone.left @ alone.right, rtol=1e-5, atol=1e-6)


def test_without_missing_entries_it_is_the_singular_value_decomposition(product, generator):
    X, weight, _ = product(missing=0.0, noise=0.3, batch=1)
    found = solve_variable_projection(X, weight, random_left(1, 12, 3, generator))
    U, S, V = torch.linalg.svd(X[0], full_matrices=False)
    best = (U[:, :3] * S[:3]) @ V[:3]
    assert_close((found.left @ found.right)[0], best, rtol=1e-3, atol=1e-4)
    assert_close(found.convergence.residual, (X[0] - best).square().mean().sqrt()[None])


def test_weights_count_as_repetitions(product, generator):
    X, weight, _ = product(noise=0.2, batch=1)
    start = random_left(1, 12, 3, generator)
    doubled = weight.clone()
    doubled[..., :20] *= 2
    found = solve_variable_projection(X, doubled, start)
    again = solve_variable_projection(
        torch.cat([X, X[..., :20]], dim=2), torch.cat([weight, weight[..., :20]], dim=2), start
    )
    assert_close(found.convergence.residual, again.convergence.residual, rtol=1e-6, atol=0)
    assert_close(found.left @ found.right, (again.left @ again.right)[..., :60])


def test_the_descent_direction_is_minus_half_the_gradient(product, generator):
    X, weight, _ = product(noise=0.3, batch=1)
    X = torch.where(weight > 0, X, 0)
    left = random_left(1, 12, 3, generator).requires_grad_()
    right, factored = solve_right(X, weight, left)
    # The right factor is optimal: its own change does not matter to first order.
    error = (weight * (X - left @ right).square()).sum()
    (gradient,) = torch.autograd.grad(error, left)
    with torch.no_grad():
        _, descent = _equations(X, weight, left, right, factored)
    assert_close(-gradient / 2, descent)


def test_the_matrix_is_ruhe_and_wedins(product, generator):
    X, weight, _ = product(rows=5, columns=7, rank=2, batch=1, missing=0.2, noise=0.3)
    X = torch.where(weight > 0, X, 0)
    left = random_left(1, 5, 2, generator)
    right, factored = solve_right(X, weight, left)
    normal, _ = _equations(X, weight, left, right, factored)
    expected = torch.zeros(10, 10, dtype=torch.float64)
    for k in range(7):
        W = weight[0, :, k].diag()
        project = W - W @ left[0] @ torch.linalg.inv(left[0].T @ W @ left[0]) @ left[0].T @ W
        expected += torch.kron(project, torch.outer(right[0, :, k], right[0, :, k]))
    assert_close(normal[0], expected)


def test_columns_with_too_few_entries_disturb_nothing(product, generator):
    X, weight, _ = product(noise=0.1, batch=1)
    start = random_left(1, 12, 3, generator)
    thin = weight[..., :2].clone()
    thin[:, 2:] = 0
    thin[:, :, 1] = 0
    wide = solve_variable_projection(
        torch.cat([X, X[..., :2]], dim=2), torch.cat([weight, thin], dim=2), start
    )
    assert isinstance(wide, LowRank)
    assert wide.right.isfinite().all()
    assert (wide.right[..., -1] == 0).all()


def test_starts_are_repeated_until_the_best_minimum_is(product, generator):
    X, weight, whole = product(batch=1)
    found = factorize_from_many(X[0], weight[0], 3, generator)
    assert found.repeated
    assert len(found.residuals) >= 2
    assert found.best.convergence.residual == found.residuals.min()
    assert_close((found.best.left @ found.best.right)[0], whole[0], rtol=1e-4, atol=1e-4)
    once = factorize_from_many(X[0], weight[0], 3, generator, repeats=1, max_starts=1)
    assert len(once.residuals) == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda X, w: (X, -w), "not negative"),
        (lambda X, w: (torch.full_like(X, torch.inf), w), "entries with weight"),
        (lambda X, w: (X[..., :2], w[..., :2]), "rank is 3"),
    ],
)
def test_what_makes_no_sense_is_refused(product, generator, change, said):
    X, weight, _ = product()
    with pytest.raises(InputError, match=said):
        solve_variable_projection(*change(X, weight), random_left(2, 12, 3, generator))
    with pytest.raises(InputError, match="repeats"):
        factorize_from_many(X[0], weight[0], 3, generator, repeats=3, max_starts=2)
