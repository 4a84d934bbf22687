import math

import pytest
import torch
from torch.testing import assert_close

from pimper_torch.geometry.frames import invert_rigid
from pimper_torch.photometry.bilinear import select
from pimper_torch.photometry.coupled import (
    Batch,
    coupled_objective,
    differentiable_together,
    solve_coupled,
)
from pimper_torch.photometry.coupling import couple_lights
from pimper_torch.photometry.harmonics import rotate_lights
from pimper_torch.photometry.variable_projection import solve_variable_projection

CHAIN = torch.tensor([[0, 1], [1, 2], [2, 3]])


@pytest.fixture
def told(generator):
    """What five patches, the last one alone, say of two views' lights."""
    root = torch.randn(5, 2, 4, 6, generator=generator, dtype=torch.float64)
    rhs = torch.randn(5, 2, 4, generator=generator, dtype=torch.float64)
    return root @ root.mT, rhs


def value(x, told, strength):
    A, b = told
    own = (x[..., None, :] @ A @ x[..., None])[..., 0, 0] - 2 * (b * x).sum(dim=2)
    apart = (x[CHAIN[:, 0]] - x[CHAIN[:, 1]]).square().sum(dim=(0, 2))
    return own.sum() + (strength * apart).sum()


def test_the_solution_is_the_minimum(told, generator):
    strength = torch.tensor([0.7, 5.0], dtype=torch.float64)
    found = couple_lights(*told, CHAIN, strength).requires_grad_()
    (slope,) = torch.autograd.grad(value(found, told, strength), found)
    assert slope.abs().max() < 1e-6  # the ridge's part


def test_without_coupling_patches_are_by_themselves(told):
    A, b = told
    found = couple_lights(A, b, CHAIN, torch.zeros(2, dtype=torch.float64))
    assert_close(found, torch.linalg.solve(A, b), rtol=1e-6, atol=1e-6)


def test_infinite_coupling_is_the_limit_of_strong_coupling_and_one_light_for_all(told):
    A, b = told
    strong, infinite = (
        couple_lights(A, b, CHAIN, torch.full((2,), s, dtype=torch.float64))
        for s in (1e6, math.inf)
    )
    assert_close(strong, infinite, rtol=0, atol=1e-3)
    assert_close(infinite[:4], infinite[:1].expand(4, 2, 4))
    assert_close(infinite[0], torch.linalg.solve(A[:4].sum(dim=0), b[:4].sum(dim=0)))
    assert_close(infinite[4], torch.linalg.solve(A[4], b[4]))


def test_a_patch_without_samples_borrows_from_its_neighbours(told):
    A, b = told
    A, b = A.clone(), b.clone()
    A[1], b[1] = 0, 0
    found = couple_lights(A, b, CHAIN, torch.ones(2, dtype=torch.float64))
    assert_close(found[1], (found[0] + found[2]) / 2, rtol=0, atol=1e-6)
    A[4], b[4] = 0, 0
    assert (couple_lights(A, b, CHAIN, torch.ones(2, dtype=torch.float64))[4] == 0).all()


@pytest.mark.parametrize("strength", [0.5, math.inf])
def test_gradients_are_those_of_the_solution(told, strength):
    A, b = told
    s = torch.full((2,), strength, dtype=torch.float64)

    def solve(root, right):
        return couple_lights(root + root.mT, right, CHAIN, s)

    assert torch.autograd.gradcheck(solve, (A.requires_grad_(), b.requires_grad_()))
    if strength < 1:
        s.requires_grad_()
        assert torch.autograd.gradcheck(lambda t: couple_lights(A, b, CHAIN, t), s)


@pytest.fixture
def batches(problem, generator):
    """Four patches in frames of their own, two a chunk, that share lights in the world."""
    given, _, shading = problem(patches=4, samples=60)
    turn = torch.linalg.qr(torch.randn(4, 3, 3, generator=generator, dtype=torch.float64)).Q
    frames = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    frames[:, :3, :3] = turn * torch.linalg.det(turn)[:, None, None]
    world = rotate_lights(invert_rigid(frames[:1]), given.lights[:1])
    lights = rotate_lights(frames, world.expand(4, -1, -1))
    noise = 0.05 * torch.randn(shading.shape[0], 20, 60, generator=generator, dtype=torch.float64)
    pull = torch.full_like(given.pull, 3.0)  # a hold on the gauge, so that factors compare
    given = given.replace(
        radiance=lights @ shading + noise, lights=lights, anchor=lights, pull=pull
    )
    return [
        Batch(
            problem=select(given, torch.tensor(part)),
            patch_from_world=frames[part],
            facet=torch.tensor(part),
        )
        for part in ([0, 2], [3, 1])
    ]


def test_zero_coupling_ends_where_patches_by_themselves_do(batches):
    found = solve_coupled(batches, CHAIN, 0.0, 200, 1e-7)
    for batch, factors in zip(batches, found, strict=True):
        alone = solve_variable_projection(batch.problem, 300, 1e-12)
        assert_close(factors.lights, alone.lights, rtol=0, atol=1e-4)
        assert_close(factors.shading, alone.shading, rtol=0, atol=1e-4)


def test_infinite_coupling_gives_one_light_in_the_world(batches):
    found = solve_coupled(batches, CHAIN, math.inf, 50, 1e-6)
    world = [
        rotate_lights(invert_rigid(batch.patch_from_world), factors.lights)
        for batch, factors in zip(batches, found, strict=True)
    ]
    one = torch.cat(world)
    assert_close(one, one[:1].expand_as(one))


@pytest.mark.parametrize("coupling", [0.3, math.inf])
def test_gradients_of_coupled_patches_are_those_of_the_solver(batches, coupling, generator):
    def solved(given):
        return solve_coupled(given, CHAIN, coupling, 400, 1e-11)

    def moved(sign, ways):
        return [
            batch.replace(
                problem=batch.problem.replace(radiance=batch.problem.radiance + sign * way)
            )
            for batch, way in zip(batches, ways, strict=True)
        ]

    start = solved(batches)
    batches = [
        batch.replace(problem=batch.problem.replace(lights=found.lights, shading=found.shading))
        for batch, found in zip(batches, start, strict=True)
    ]
    start = solved(batches)
    leaves = [batch.problem.radiance.clone().requires_grad_() for batch in batches]
    given = [
        batch.replace(problem=batch.problem.replace(radiance=leaf))
        for batch, leaf in zip(batches, leaves, strict=True)
    ]
    found = differentiable_together(given, start, CHAIN, coupling)

    def draw(like):
        return torch.randn(like.shape, generator=generator, dtype=torch.float64)

    probes = [(draw(one.lights), draw(one.shading)) for one in found]

    def total(answers):
        return sum(
            (a * one.lights).sum() + (b * one.shading).sum()
            for (a, b), one in zip(probes, answers, strict=True)
        )

    slopes = torch.autograd.grad(total(found), leaves)
    ways = [draw(leaf) for leaf in leaves]
    step = 1e-3
    ahead, behind = (total(solved(moved(sign * step, ways))) for sign in (1, -1))
    along = sum((slope * way).sum() for slope, way in zip(slopes, ways, strict=True))
    assert_close(along, (ahead - behind) / (2 * step), rtol=1e-3, atol=1e-4)


def test_coupling_in_between_lowers_its_objective_and_is_at_a_minimum(batches):
    known = torch.cat([(c.problem.weight @ c.problem.shading[:, 0, :, None] ** 2) for c in batches])
    strength = 0.3 * known[..., 0].mean(dim=0)
    found = solve_coupled(batches, CHAIN, 0.3, 200, 1e-7)
    least = coupled_objective(batches, found, CHAIN, strength)
    costs = [
        float(
            coupled_objective(batches, solve_coupled(batches, CHAIN, 0.3, n, 0.0), CHAIN, strength)
        )
        for n in (1, 2, 5)
    ]
    assert costs[0] > costs[1] > costs[2] > least
    lights = [factors.lights.clone().requires_grad_() for factors in found]
    moved = [f.replace(lights=light) for f, light in zip(found, lights, strict=True)]
    slopes = torch.autograd.grad(coupled_objective(batches, moved, CHAIN, strength), lights)
    assert max(float(slope.abs().max()) for slope in slopes) < 1e-4 * float(least)
