import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.records import StopCause
from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.factorization.low_rank import (
    FreeManifold,
    factorize_from_many,
    low_rank_problem,
    random_left,
    singular_left,
)
from pimper_torch.stages.photometry.balm import solve_balm
from pimper_torch.stages.photometry.bilinear import Bilinear, equations_of_samples, update_shading
from pimper_torch.stages.photometry.cone import Cone
from pimper_torch.stages.photometry.quadratics import apply_packed
from pimper_torch.stages.photometry.variable_projection import (
    curvature_of_lights,
    solve_variable_projection,
)


def factorize(matrix, weight, start):
    return solve_variable_projection(low_rank_problem(matrix, weight, start))


def best_right(problem):
    equations = equations_of_samples(problem, problem.lights, problem.weight)
    return update_shading(problem, *equations, problem.shading)


@pytest.fixture
def product(generator):
    """Products of rank three with missing entries."""

    def make(rows=12, columns=60, rank=3, batch=2, missing=0.3, noise=0.0):
        def draw(*shape):
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        X = draw(batch, rows, rank) @ draw(batch, rank, columns)
        X = X + noise * draw(*X.shape)
        seen = torch.rand(X.shape, generator=generator) >= missing
        seen[:, : rank + 2] = True  # every column determines its coefficients
        return torch.where(seen, X, torch.nan), seen.double(), X

    return make


def test_missing_entries_are_recovered(product, generator):
    X, weight, whole = product()
    found = factorize(X, weight, random_left(2, 12, 3, generator))
    assert_close(found.lights @ found.shading, whole, rtol=1e-5, atol=1e-5)
    assert (found.convergence.residual < 1e-6).all()
    assert found.convergence.converged.all()
    assert_close(found.lights.mT @ found.lights, torch.eye(3).double().expand(2, 3, 3))


def test_singular_vectors_of_the_filled_matrix_start_near_the_solution(product):
    X, weight, whole = product(missing=0.1)
    left = singular_left(X, weight, 3)
    assert_close(left.mT @ left, torch.eye(3).double().expand(2, 3, 3))
    assert (left @ (left.mT @ whole) - whole).norm() < 0.05 * whole.norm()


def test_matrices_of_a_batch_are_independent(product, generator):
    X, weight, _ = product(noise=0.1)
    start = random_left(2, 12, 3, generator)
    both, alone = factorize(X, weight, start), factorize(X[1:], weight[1:], start[1:])
    assert_close(both.convergence.residual[1:], alone.convergence.residual)
    products = [found.lights[-1:] @ found.shading[-1:] for found in (both, alone)]
    assert_close(*products, rtol=1e-5, atol=1e-6)


def test_without_missing_entries_the_solution_is_the_svd(product, generator):
    X, weight, _ = product(missing=0.0, noise=0.3, batch=1)
    found = factorize(X, weight, random_left(1, 12, 3, generator))
    U, S, V = torch.linalg.svd(X[0], full_matrices=False)
    best = (U[:, :3] * S[:3]) @ V[:3]
    assert_close((found.lights @ found.shading)[0], best, rtol=1e-3, atol=1e-4)
    assert_close(found.convergence.residual, (X[0] - best).square().mean().sqrt()[None])


def test_weights_count_as_repetitions_and_sparse_columns_are_ignored(product, generator):
    X, weight, _ = product(noise=0.2, batch=1)
    start = random_left(1, 12, 3, generator)
    doubled, thin = weight.clone(), weight[..., :2].clone()
    doubled[..., :20] *= 2
    thin[:, 2:], thin[:, :, 1] = 0, 0
    found = factorize(X, doubled, start)
    parts = weight, weight[..., :20], thin
    columns = torch.cat([X, X[..., :20], X[..., :2]], dim=2)
    again = factorize(columns, torch.cat(parts, dim=2), start)
    assert again.shading.isfinite().all()
    assert (again.shading[..., -1] == 0).all()
    assert_close(
        found.lights @ found.shading, (again.lights @ again.shading)[..., :60], rtol=1e-5, atol=1e-6
    )


def test_the_normal_matrix_is_that_of_ruhe_and_wedin(product, generator):
    X, weight, _ = product(rows=5, columns=7, rank=2, batch=1, missing=0.2, noise=0.3)
    given = low_rank_problem(X, weight, random_left(1, 5, 2, generator))
    right, left = best_right(given), given.lights
    expected = torch.zeros(10, 10, dtype=torch.float64)
    for k in range(7):
        W = weight[0, :, k].diag()
        project = W - W @ left[0] @ torch.linalg.inv(left[0].T @ W @ left[0]) @ left[0].T @ W
        expected += torch.kron(project, torch.outer(right[0, :, k], right[0, :, k]))
    assert_close(curvature_of_lights(given, left, right, given.weight)[0], expected)


def test_starts_are_added_until_the_best_minimum_is_repeated(product, generator):
    X, weight, whole = product(batch=1)
    found = factorize_from_many(X[0], weight[0], 3, generator)
    assert found.repeated
    assert len(found.residuals) >= 2
    assert found.best.convergence.residual == found.residuals.min()
    assert_close((found.best.lights @ found.best.shading)[0], whole[0], rtol=1e-4, atol=1e-4)
    once = factorize_from_many(X[0], weight[0], 3, generator, repeats=1, max_starts=1)
    assert len(once.residuals) == 1


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda X, w: (X, -w), "weight that is negative"),
        (lambda X, w: (torch.full_like(X, torch.inf), w), "without a finite value"),
        (lambda X, w: (X[..., :2], w[..., :2]), "rank is 3"),
    ],
)
def test_impossible_matrices_are_rejected(product, generator, change, found):
    X, weight, _ = product()
    with pytest.raises(InputError, match=found):
        factorize(*change(X, weight), random_left(2, 12, 3, generator))
    with pytest.raises(InputError, match="repeats"):
        factorize_from_many(X[0], weight[0], 3, generator, repeats=3, max_starts=2)


def test_an_array_is_taken_like_a_tensor(product):
    X, weight, _ = product(batch=1)
    found, same = (
        factorize_from_many(*given, 3, torch.Generator().manual_seed(1))
        for given in ((X[0], weight[0]), (X[0].numpy(), weight[0].numpy()))
    )
    assert torch.equal(found.best.lights, same.best.lights)
    with pytest.raises(InputError, match="needed: two matrices of one size"):
        factorize_from_many(X, weight, 3, torch.Generator())


MANIFOLDS = pytest.mark.parametrize("manifold", [FreeManifold(), Cone()])


def draw(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def some(manifold, count, generator):
    normals = normalize(draw(generator, count, 3), dim=-1)
    albedo = 0.5 + draw(generator, count).abs()
    vectors = manifold.join(albedo, normals) if manifold.rank == 4 else albedo[:, None] * normals
    return vectors, albedo, normals


@MANIFOLDS
def test_albedo_and_normal_are_joined_and_split(manifold, generator):
    vectors, albedo, normals = some(manifold, 30, generator)
    assert vectors.shape == (30, manifold.rank)
    found = manifold.split(vectors)
    assert_close(found[0], albedo)
    assert_close(found[1], normals)
    assert_close(manifold.project(vectors), vectors)
    assert_close(manifold.retract(vectors), vectors)


def test_tangents_are_derivatives_by_albedo_and_rotation_of_the_normal(generator):
    manifold = Cone()
    vectors, albedo, _ = some(manifold, 20, generator)
    for place, column in enumerate(manifold.tangents(vectors.mT)):
        ahead = manifold.retract(vectors + 1e-6 * column.mT)
        assert_close((ahead - vectors) / 1e-6, column.mT, rtol=0, atol=1e-5)
        moved, rotated = manifold.split(ahead)
        angle = (rotated - manifold.split(vectors)[1]).norm(dim=-1) * albedo
        by_albedo = torch.full_like(albedo, 1e-6 * (place == 0))
        assert_close(moved - albedo, by_albedo, rtol=0, atol=1e-11)
        assert_close(angle, 1e-6 - by_albedo, rtol=0, atol=5e-12)


def test_the_normal_prior_is_quadratic_in_the_deviation(generator):
    vectors, albedo, normals = some(Cone(), 20, generator)
    other = normalize(draw(generator, 20, 3), dim=-1)
    form = Cone().normal_prior(other.mT)
    cost = (vectors.mT * apply_packed(form, vectors.mT)).sum(dim=0)
    assert_close(cost, albedo**2 * (normals - other).square().sum(dim=1))


@pytest.mark.parametrize(
    ("solve", "tolerance"), [(solve_balm, 1e-6), (solve_variable_projection, 1e-12)]
)
@MANIFOLDS
def test_every_solver_fits_the_data_on_every_manifold(solve, tolerance, manifold, generator):
    vectors = torch.stack([some(manifold, 120, generator)[0].mT for _ in range(2)])
    lights = draw(generator, 2, 25, manifold.rank)
    weight = (torch.rand(2, 25, 120, generator=generator) > 0.3).double()
    weight[1] = 0
    start = lights + 0.03 * draw(generator, *lights.shape)
    near = manifold.project((vectors + 0.03 * draw(generator, *vectors.shape)).mT).mT
    problem = Bilinear(
        radiance=weight * (lights @ vectors),
        weight=weight,
        lights=start,
        prior_mean=start,
        shading=near,
        regularization=torch.zeros(2, 25, dtype=torch.float64),
        manifold=manifold,
    )
    found = solve(problem, 600, tolerance)
    assert found.convergence.residual[0] < 3e-3  # of radiances about 2
    assert found.convergence.cause.tolist() == [StopCause.CONVERGED, StopCause.EMPTY]
    assert_close(manifold.project(found.shading.mT).mT, found.shading)
    stopped = solve(problem, 2, tolerance)
    assert stopped.convergence.cause[0] == StopCause.LIMIT
    assert not stopped.convergence.converged.any()
