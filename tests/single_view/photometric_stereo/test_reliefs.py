"""Bas-relief transformations, their canonical forms, and lights that determine one."""

import pytest
import torch
from reliefs import align_reliefs
from torch.testing import assert_close

from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.factorization.bas_relief import (
    BasRelief,
    convex,
    relief_from_strength,
    standard_relief,
)
from tests.single_view.scenes import BALL, BUMPY, strong_lights


def relief(mu, nu, lam):
    mu, nu, lam = torch.tensor([mu, nu, lam], dtype=torch.float64)
    return BasRelief(mu=mu, nu=nu, lam=lam)


def some(generator):
    return relief(*torch.randn(3, generator=generator, dtype=torch.float64).tolist())


def test_the_slopes_change_as_those_of_the_transformed_surface(generator):
    move = some(generator)
    p, q, albedo = torch.randn(3, 50, generator=generator, dtype=torch.float64)
    x, y, z = move.on_shading(albedo.exp() * torch.stack([p, q, -torch.ones_like(p)]))
    assert_close(-x / z, move.lam * p + move.mu)
    assert_close(-y / z, move.lam * q + move.nu)


def test_transformations_form_a_group_and_keep_images(generator):
    move, second = some(generator), some(generator)
    shading = torch.randn(3, 40, generator=generator, dtype=torch.float64)
    lights = torch.randn(7, 3, generator=generator, dtype=torch.float64)
    assert_close(move.on_lights(lights) @ move.on_shading(shading), lights @ shading)
    assert_close(move.inverse().on_shading(move.on_shading(shading)), shading)
    assert_close(second.after(move).matrix, second.matrix @ move.matrix)


def test_alignment_recovers_the_transformation_and_ignores_zero_weights(generator):
    move = some(generator)
    shading = torch.randn(3, 60, generator=generator, dtype=torch.float64)
    moved, weight = 3.0 * move.on_shading(shading), torch.ones(60, dtype=torch.float64)
    moved[:, :10], weight[:10] = 100.0, 0
    assert_close(align_reliefs(shading, moved, weight).matrix, move.matrix)


@pytest.mark.parametrize("lam", [0.7, -1.6])
def test_all_reliefs_of_a_surface_have_one_standard_form(generator, lam):
    b = torch.randn(3, 80, generator=generator, dtype=torch.float64)
    moved = relief(0.4, -1.1, lam).on_shading(b)
    form = standard_relief(b).on_shading(b)
    other = standard_relief(moved).on_shading(moved)
    mirror = -1.0 if lam < 0 else 1.0
    assert_close(other, form * form.new_tensor([[mirror], [mirror], [1.0]]))
    x, y, z = form
    assert_close(torch.stack([(x * z).sum(), (y * z).sum()]), torch.zeros(2).double())
    assert_close((x * x + y * y).sum(), (z * z).sum())


def test_a_plane_has_no_standard_form():
    b = torch.tensor([[0.0], [0.0], [-1.0]]) * torch.arange(1, 5)
    assert standard_relief(b).lam.isnan()


def rounded(shading, weight, mask):
    return convex(standard_relief(shading, weight), shading, weight, mask).on_shading(shading)


@pytest.mark.parametrize("lam", [0.4, -0.25])
def test_any_relief_of_a_ball_is_restored_to_a_ball(lam):
    found = rounded(relief(0.3, -0.7, lam).on_shading(BALL.columns), BALL.even, BALL.mask)
    # A disc without its rim is flatter than a hemisphere, by 3 %, from 0.97 squared.
    assert_close(found[2], BALL.columns[2])
    assert (found[:2] - BALL.columns[:2]).abs().max() < 0.07


def test_the_result_does_not_depend_on_the_initial_relief(generator):
    weight = torch.rand(BUMPY.columns.shape[1], generator=generator, dtype=torch.float64)
    moved = relief(0.2, 0.5, -3.0).on_shading(BUMPY.columns)
    assert_close(rounded(BUMPY.columns, weight, BUMPY.mask), rounded(moved, weight, BUMPY.mask))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_convex_solution_has_outward_normals(sign):
    assert convex(relief(0.0, 0.0, sign), BALL.columns, BALL.even, BALL.mask).lam == 1


@pytest.mark.parametrize("shrunk", [0.05, 1.0, 20.0])
def test_equal_light_strengths_resolve_the_relief(generator, shrunk):
    lights, tilted = strong_lights(generator, 12), relief(0.4, -0.3, 0.35)
    lights[3] *= 1.4  # an outlier
    moved, shading = shrunk * tilted.on_lights(lights), tilted.on_shading(BUMPY.columns)
    found = relief_from_strength(moved, shading, BUMPY.even, BUMPY.mask)
    assert_close(found.after(tilted).matrix, torch.eye(3).double(), atol=2e-3, rtol=0)
    with pytest.raises(InputError, match="3 are given; needed: four"):
        relief_from_strength(moved[:3], shading, BUMPY.even, BUMPY.mask)
