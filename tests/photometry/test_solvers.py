import pytest
import torch
from torch.testing import assert_close

from pimper_torch.linalg.robust import Cauchy
from pimper_torch.single_view.factorization.ambiguity import align_factorizations
from pimper_torch.stages.photometry.balm import solve_balm
from pimper_torch.stages.photometry.bilinear import (
    equations_of_samples,
    evaluate,
    update_shading,
)
from pimper_torch.stages.photometry.sample_estimates import refine_on_manifold
from pimper_torch.stages.photometry.variable_projection import solve_variable_projection


def objective(*given):
    return evaluate(*given)[0]


def solve_projection(problem, max_iterations, tolerance):
    # Other tolerances are on shading vectors; the objective grows with their square.
    return solve_variable_projection(problem, max_iterations, tolerance**2)


def solve_compiled(problem, max_iterations, tolerance):
    found = solve_projection(problem.to(torch.float32), max_iterations, tolerance)
    return found.to(torch.float64)


SOLVERS = pytest.mark.parametrize("solve", [solve_balm, solve_projection, solve_compiled])


def error(found, truth, weight, least=7):
    """Largest error of shading vectors with enough observations, up to the ambiguity."""
    often = (weight.sum(dim=1) >= least).double()
    rotation = align_factorizations(found, truth, often)
    return ((rotation.on_shading(found) - truth).abs().amax(dim=1) * often).max()


@SOLVERS
def test_factors_are_recovered_up_to_lorentz_with_60_percent_missing(problem, solve):
    given, _, shading = problem(patches=1, missing=0.6)
    found = solve(given, 600, 1e-7)
    assert found.convergence.residual.max() < 1e-4  # of radiances about 1; the start is off by 0.1
    assert error(found.shading, shading, given.weight) < 5e-3
    assert_close(found.shading[:, 0], found.shading[:, 1:].norm(dim=1))
    assert (found.shading - given.shading).abs().max() > 0.05


def test_the_slope_with_respect_to_lights_is_minus_half_the_gradient(problem, generator):
    given, _, _ = problem(patches=2, samples=40, missing=0.3)
    _, normals = given.manifold.split(given.shading.mT)
    given = given.replace(
        regularization=torch.full_like(given.regularization, 3.0),
        prior_mean=given.prior_mean + 0.1,
        prior=0.1 * given.manifold.normal_prior(normals.mT),
    )
    noise = torch.randn(given.radiance.shape, generator=generator, dtype=torch.float64)
    given = given.replace(radiance=given.radiance + 0.1 * noise)
    lights = given.lights.clone().requires_grad_()
    # The shading is optimal for the lights, so its change does not matter to first order.
    equations = equations_of_samples(given, given.lights, given.weight)
    shading = update_shading(given, *equations, given.shading, 60)
    again = update_shading(given, *equations_of_samples(given, lights, given.weight), shading)
    value = objective(given, lights, again, given.weight).sum()
    (eliminated,) = torch.autograd.grad(value, lights)
    _, slope = evaluate(given, given.lights, shading, given.weight)
    assert_close(-eliminated / 2, slope, rtol=1e-5, atol=1e-6)


@SOLVERS
def test_lights_with_a_strong_prior_keep_its_mean(problem, solve):
    given, _, _ = problem()
    held = given.replace(regularization=torch.full_like(given.regularization, 1e9))
    assert_close(solve(held, 40, 1e-6).lights, given.prior_mean, rtol=0, atol=1e-5)
    assert (solve(given, 40, 1e-6).lights - given.prior_mean).abs().max() > 1e-2


@SOLVERS
def test_robust_weights_suppress_outliers(problem, solve, generator):
    given, lights, shading = problem(views=20)
    gross = torch.rand(given.radiance.shape, generator=generator) < 0.1
    given = given.replace(
        radiance=torch.where(gross, given.radiance + 1.5, given.radiance),
        lights=lights,
        prior_mean=lights,
        regularization=torch.full_like(given.regularization, 1e9),
    )
    plain = (solve(given, 100, 1e-6).shading - shading).norm(dim=1).median()
    robust = solve(given.replace(loss=Cauchy()), 200, 1e-6)
    assert (robust.shading - shading).norm(dim=1).median() < 0.02 * plain
    assert robust.weight[gross].max() < 0.1


@SOLVERS
def test_patches_of_a_batch_are_solved_independently(problem, solve):
    given, _, _ = problem(patches=3, samples=60)
    empty = given.replace(
        weight=given.weight * torch.tensor([1.0, 0, 1]).double()[:, None, None],
        radiance=given.radiance * torch.tensor([1.0, 0, 1]).double()[:, None, None],
    )
    together = solve(empty, 60, 1e-5)
    for patch in (0, 2):
        alone = solve(given.take([patch]), 60, 1e-5)
        assert_close(together.shading[patch], alone.shading[0], rtol=0, atol=1e-9)
        assert together.convergence.iterations[patch] == alone.convergence.iterations[0]
    assert together.shading.isfinite().all()
    assert together.lights.isfinite().all()


def test_refinement_reaches_the_minimum_per_sample_with_its_gradient(problem):
    given, lights, _ = problem(patches=1, samples=12, off=0.02)
    given = given.replace(
        lights=lights, prior_mean=lights, regularization=torch.full_like(given.regularization, 1e9)
    )
    noisy = given.radiance + 0.01 * torch.sin(torch.arange(240.0)).double().reshape(1, 20, 12)
    given = given.replace(radiance=noisy)
    found = solve_balm(given, 300, 1e-7)
    albedo, _, _ = refine_on_manifold(given, found)
    again = solve_projection(given.replace(shading=found.shading), 500, 1e-12)
    assert_close(albedo, again.shading[:, 0], rtol=0, atol=1e-5)

    radiance = given.radiance.clone().requires_grad_()
    refine_on_manifold(given.replace(radiance=radiance), found)[0][0, 3].backward()
    step = 1e-3
    there = []
    for sign in (1, -1):
        moved = noisy.clone()
        moved[0, 5, 3] += sign * step
        there.append(solve_projection(given.replace(radiance=moved), 500, 1e-12).shading[0, 0, 3])
    slope = (there[0] - there[1]) / (2 * step)
    assert_close(radiance.grad[0, 5, 3], slope, rtol=0.05, atol=1e-4)  # Gauss-Newton's part
    assert (radiance.grad[0, :, :3] == 0).all()


def test_factors_are_recovered_with_contiguous_blocks_missing(problem):
    given, _, shading = problem()
    weight = torch.ones_like(given.weight)
    for view in range(20):  # each view lacks a different contiguous half, as under occlusion
        away = (torch.arange(150) - 7 * view) % 150 < 75
        weight[:, view, away] = 0
    given = given.replace(weight=weight, radiance=weight * given.radiance)
    found = solve_projection(given, 800, 1e-8)
    assert error(found.shading, shading, weight) < 1e-3
