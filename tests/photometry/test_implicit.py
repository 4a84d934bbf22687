import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.photometry.bilinear import Bilinear
from pimper_torch.photometry.implicit import differentiable
from pimper_torch.photometry.manifolds import Cone, Free, SecondOrder
from pimper_torch.photometry.robust import Cauchy, Squares
from pimper_torch.photometry.variable_projection import solve_variable_projection


@pytest.fixture
def noisy(generator):
    """A small problem whose data no lights and normals explain, all freedom held."""

    def make(manifold, loss=None, patches=2, views=8, samples=9):
        def draw(*shape):
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        normals = normalize(draw(patches, samples, 3), dim=-1)
        albedo = 0.6 + 0.2 * draw(patches, samples).abs()
        shading = manifold.join(albedo, normals).mT
        lights = draw(patches, views, manifold.rank)
        weight = (torch.rand(patches, views, samples, generator=generator) > 0.15).double()
        return Bilinear(
            radiance=lights @ shading + 0.1 * draw(patches, views, samples),
            weight=weight,
            lights=lights,
            anchor=lights + 0.05 * draw(*lights.shape),
            shading=shading,
            pull=torch.full((patches, views), 2.0, dtype=torch.float64),
            prior=0.5 * manifold.bend(normals.mT),
            manifold=manifold,
            loss=loss or Squares(),
        )

    return make


def solved(problem):
    return solve_variable_projection(problem, 400, 1e-15, small_steps=4)


@pytest.mark.parametrize("manifold", [Free(), Cone(), SecondOrder()])
def test_gradients_are_those_of_the_solver(noisy, manifold, generator):
    problem = noisy(manifold)
    start = solved(problem)
    assert start.convergence.converged.all()

    def answer(radiance, anchor, pull, prior, solve):
        given = problem.replace(radiance=radiance, anchor=anchor, pull=pull, prior=prior)
        found = solve(given)
        return torch.cat([found.lights.flatten(1), found.shading.flatten(1)], dim=1)

    def again(given):
        return solved(given.replace(lights=start.lights, shading=start.shading))

    data = [problem.radiance, problem.anchor, problem.pull, problem.prior]
    leaves = [one.clone().requires_grad_() for one in data]
    found = answer(*leaves, lambda given: differentiable(given, start))
    assert_close(found, answer(*data, lambda _: start))
    probe = torch.randn(found.shape, generator=generator, dtype=torch.float64)
    slopes = torch.autograd.grad((probe * found).sum(), leaves)
    # The solver compares objectives, so that it knows its answer to 1e-8: steps of 1e-3 leave
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


def test_gradcheck_passes_through_the_solver(noisy):
    problem = noisy(Cone(), patches=1, views=6, samples=5)
    start = solved(problem)

    class Solve(torch.autograd.Function):
        """The solver forward, the implicit function backward."""

        @staticmethod
        def forward(ctx, radiance):
            ctx.save_for_backward(radiance)
            given = problem.replace(radiance=radiance, lights=start.lights, shading=start.shading)
            found = solved(given)
            ctx.found = found
            return found.lights.clone(), found.shading.clone()

        @staticmethod
        def backward(ctx, on_lights, on_shading):
            (radiance,) = ctx.saved_tensors
            with torch.enable_grad():
                leaf = radiance.detach().requires_grad_()
                found = differentiable(problem.replace(radiance=leaf), ctx.found)
                total = (on_lights * found.lights).sum() + (on_shading * found.shading).sum()
                return torch.autograd.grad(total, leaf)

    radiance = problem.radiance.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        Solve.apply, radiance, eps=1e-3, atol=1e-4, rtol=1e-3, fast_mode=True
    )


def test_robust_weights_take_part(noisy, generator):
    # The deviation is constant to the gradient: a loss whose scale ignores it.
    class Fixed(Cauchy):
        def weights(self, residual, deviation):
            return super().weights(residual, torch.full_like(deviation, 0.1))

    problem = noisy(Cone(), Fixed(), patches=1)
    start = solved(problem)
    leaf = problem.radiance.clone().requires_grad_()
    found = differentiable(problem.replace(radiance=leaf), start)
    probe = torch.randn(found.lights.shape, generator=generator, dtype=torch.float64)
    (slope,) = torch.autograd.grad((probe * found.lights).sum(), leaf)
    way = torch.randn(leaf.shape, generator=generator, dtype=torch.float64)
    there = [
        (
            probe
            * solved(
                problem.replace(
                    radiance=problem.radiance + sign * 1e-3 * way,
                    lights=start.lights,
                    shading=start.shading,
                )
            ).lights
        ).sum()
        for sign in (1, -1)
    ]
    assert_close((slope * way).sum(), (there[0] - there[1]) / 2e-3, rtol=1e-3, atol=1e-5)
