import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.records import StopCause
from pimper_torch.single_view.factorization.low_rank import FreeManifold
from pimper_torch.stages.photometry.balm import solve_balm
from pimper_torch.stages.photometry.bilinear import Bilinear
from pimper_torch.stages.photometry.cone import Cone
from pimper_torch.stages.photometry.quadratics import apply_packed
from pimper_torch.stages.photometry.variable_projection import solve_variable_projection

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
