from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close
from twins import using

from pimper_bench.derivatives import check_derivatives
from pimper_torch.linalg.robust import Cauchy, GemanMcClure, Huber, Squares
from pimper_torch.single_view.factorization.low_rank import FreeManifold
from pimper_torch.stages.photometry.bilinear import Bilinear
from pimper_torch.stages.photometry.cone import Cone
from pimper_torch.stages.photometry.factor_gradients import differentiable
from pimper_torch.stages.photometry.quadratics import outer
from pimper_torch.stages.photometry.variable_projection import solve_variable_projection


@pytest.fixture
def noisy(generator):
    """A small problem with noise and with priors on all factors."""

    def make(manifold, loss=None, patches=2, views=8, samples=9):
        def draw(*shape):
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        normals = normalize(draw(patches, samples, 3), dim=-1)
        albedo = 0.6 + 0.2 * draw(patches, samples).abs()
        if isinstance(manifold, FreeManifold):
            shading = (albedo[..., None] * normals).mT
            prior = torch.tensor([1.0, 0, 0, 1, 0, 1]).double()[:, None] - outer(normals.mT)
        else:
            shading, prior = manifold.join(albedo, normals).mT, manifold.normal_prior(normals.mT)
        lights = draw(patches, views, manifold.rank)
        weight = (torch.rand(patches, views, samples, generator=generator) > 0.15).double()
        return Bilinear(
            radiance=lights @ shading + 0.1 * draw(patches, views, samples),
            weight=weight,
            lights=lights,
            prior_mean=lights + 0.05 * draw(*lights.shape),
            shading=shading,
            regularization=torch.full((patches, views), 2.0, dtype=torch.float64),
            prior=0.5 * prior,
            manifold=manifold,
            loss=loss or Squares(),
        )

    return make


def solved(problem):
    return solve_variable_projection(problem, 400, 1e-15, small_steps=4)


@pytest.mark.parametrize("manifold", [FreeManifold(), Cone()])
def test_implicit_gradients_match_differences_of_the_solver(noisy, manifold, generator):
    problem = noisy(manifold)
    start = solved(problem)
    assert start.convergence.converged.all()

    def answer(radiance, prior_mean, regularization, prior, solve):
        given = problem.replace(
            radiance=radiance, prior_mean=prior_mean, regularization=regularization, prior=prior
        )
        found = solve(given)
        return torch.cat([found.lights.flatten(1), found.shading.flatten(1)], dim=1)

    def again(given):
        return solved(given.replace(lights=start.lights, shading=start.shading))

    data = [problem.radiance, problem.prior_mean, problem.regularization, problem.prior]
    leaves = [one.clone().requires_grad_() for one in data]
    found = answer(*leaves, lambda given: differentiable(given, start))
    assert_close(found, answer(*data, lambda _: start))
    probe = torch.randn(found.shape, generator=generator, dtype=torch.float64)
    slopes = torch.autograd.grad((probe * found).sum(), leaves)
    # The solver compares objectives, so its solution has an error of 1e-8: steps of 1e-3 leave
    # five digits of a difference.
    step = 1e-3
    for place, slope in enumerate(slopes):
        way = torch.randn(slope.shape, generator=generator, dtype=torch.float64)
        there = []
        for sign in (1, -1):
            moved = list(data)
            moved[place] = moved[place] + sign * step * way
            there.append((probe * answer(*moved, again)).sum())
        expected = (there[0] - there[1]) / (2 * step)
        assert_close((slope * way).sum(), expected, rtol=1e-3, atol=1e-5)


def test_robust_weights_and_their_deviation_are_differentiated(noisy, generator):
    problem = noisy(Cone(), Cauchy(), patches=1, samples=12)

    def answer(x):
        given = problem.replace(radiance=x["radiance"], prior=x["prior"])
        found = differentiable(given, solved(given.detach()))
        return {
            "lights": found.lights,
            "shading": found.shading,
            "weight": found.weight,
            "residual": found.convergence.residual,
        }

    inputs = {"radiance": problem.radiance, "prior": problem.prior}
    for check in check_derivatives(answer, inputs, generator, directions=1).values():
        assert check.smooth.all()
        assert check.spread < 1e-4


@pytest.mark.parametrize("stride", [1, 3])
@pytest.mark.parametrize("loss", [Squares(), Cauchy(), GemanMcClure(), Huber()])
def test_the_compiled_adjoint_matches_the_reference(noisy, generator, loss, stride):
    given = noisy(Cone(), loss, samples=40).replace(stride=stride)
    weight = given.weight.clone()
    weight[:, 3], weight[:, :, 5] = 0, 0  # a view and a sample without data
    given = given.replace(weight=weight, radiance=weight * given.radiance)
    start = solved(given)
    names = "radiance", "weight", "prior_mean", "regularization", "prior"
    outputs, slopes = [], []
    for how in ("numba", "torch"):
        leaves = {name: getattr(given, name).clone().requires_grad_() for name in names}
        with using(how):
            found = differentiable(given.replace(**leaves), start)
        parts = found.lights, found.shading, found.weight, found.convergence.residual
        probes = torch.Generator().manual_seed(5)
        total = sum(
            (torch.randn(part.shape, generator=probes, dtype=torch.float64) * part).sum()
            for part in parts
        )
        outputs.append(parts)
        slopes.append(torch.autograd.grad(total, leaves.values()))
    counts = (weight > 0).any(dim=1)[:, None]
    for one, other in zip(*outputs, strict=True):
        some = counts if one.ndim == 3 and one.shape[2] == 40 else torch.ones(())
        assert_close(some * one, some * other, rtol=0, atol=1e-9)  # error of the Newton steps
    for name, one, other in zip(names, *slopes, strict=True):
        some = {"weight": weight > 0, "prior": counts}.get(name, torch.ones(()))
        expected = some * other
        assert_close(some * one, expected, rtol=0, atol=1e-8 * float(expected.abs().max()))


@pytest.mark.parametrize("how", ["numba", "torch"])
def test_a_patch_without_light_and_albedo_has_zero_gradients(noisy, how):
    given = noisy(Cone(), Cauchy())
    names = "radiance", "lights", "prior_mean", "shading", "regularization", "prior"
    first = {name: getattr(given, name).clone() for name in names}
    for values in first.values():
        values[1] = 0
    given = given.replace(**first)
    radiance = given.radiance.clone().requires_grad_()
    with using(how):
        found = differentiable(given.replace(radiance=radiance), solved(given))
    (slope,) = torch.autograd.grad(found.lights.sum() + found.shading.sum(), radiance)
    assert found.lights.isfinite().all()
    assert slope.isfinite().all()
    assert (slope[0] != 0).any()
    assert (slope[1] == 0).all()


def test_an_unconverged_solution_is_refined_to_convergence(noisy):
    problem = noisy(Cone(), Cauchy(), patches=2, samples=20)
    early = solve_variable_projection(problem, 400, 1e-3, small_steps=1)
    radiance = problem.radiance.clone().requires_grad_()
    found = differentiable(problem.replace(radiance=radiance), early)
    exact = differentiable(problem.replace(radiance=radiance), solved(problem))
    assert (early.lights - exact.lights).abs().max() > 1e-5
    assert_close(found.lights, exact.lights, rtol=0, atol=1e-10)
    assert_close(found.shading, exact.shading, rtol=0, atol=1e-10)


def test_gradients_are_thread_safe(noisy):
    # Forward-mode differentiation is not: its levels are counted over all threads.
    problem = noisy(Cone(), Cauchy(), patches=1, samples=12)
    found = solved(problem)

    def slope(_):
        radiance = problem.radiance.clone().requires_grad_()
        lights = differentiable(problem.replace(radiance=radiance), found).lights
        return torch.autograd.grad(lights.sum(), radiance)[0]

    alone = slope(None)
    with ThreadPoolExecutor(4) as pool:
        for other in pool.map(slope, range(16)):
            assert_close(other, alone)
