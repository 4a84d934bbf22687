import torch
from reliefs import align_reliefs
from torch.testing import assert_close

from pimper_torch.single_view.factorization.bas_relief import BasRelief


def some(generator):
    mu, nu, lam = torch.randn(3, generator=generator, dtype=torch.float64)
    return BasRelief(mu=mu, nu=nu, lam=lam)


def test_the_slopes_change_as_those_of_the_transformed_surface(generator):
    move = some(generator)
    p, q, albedo = torch.randn(3, 50, generator=generator, dtype=torch.float64)
    albedo = albedo.exp()
    shading = albedo * torch.stack([p, q, -torch.ones_like(p)])
    x, y, z = move.on_shading(shading)
    assert_close(-x / z, move.lam * p + move.mu)
    assert_close(-y / z, move.lam * q + move.nu)


def test_it_changes_no_image_and_is_undone_by_its_inverse(generator):
    move = some(generator)
    shading = torch.randn(3, 40, generator=generator, dtype=torch.float64)
    lights = torch.randn(7, 3, generator=generator, dtype=torch.float64)
    assert_close(move.on_lights(lights) @ move.on_shading(shading), lights @ shading)
    assert_close(move.inverse().on_shading(move.on_shading(shading)), shading)


def test_transformations_form_a_group(generator):
    first, second = some(generator), some(generator)
    assert_close(second.after(first).matrix, second.matrix @ first.matrix)


def test_alignment_finds_the_transformation_and_ignores_what_has_no_weight(generator):
    move = some(generator)
    shading = torch.randn(3, 60, generator=generator, dtype=torch.float64)
    moved = 3.0 * move.on_shading(shading)
    moved[:, :10] = 100.0
    weight = torch.ones(60, dtype=torch.float64)
    weight[:10] = 0
    found = align_reliefs(shading, moved, weight)
    assert_close(found.matrix, move.matrix)
