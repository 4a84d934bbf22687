import pytest
import torch
from reliefs import ball, bumps, regions
from torch.testing import assert_close

from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.photometric_stereo.albedo_entropy import (
    albedo_entropy,
    resolve_by_albedo_entropy,
)

HIDDEN = BasRelief(
    mu=torch.tensor(0.7).double(), nu=torch.tensor(-0.4).double(), lam=torch.tensor(1.6).double()
)


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(1)


def error_deg(shading, normals):
    cross = torch.linalg.cross(shading, normals, dim=0).norm(dim=0)
    return torch.rad2deg(torch.atan2(cross, (shading * normals).sum(dim=0))).mean()


def painted(generator, shape):
    normals, mask = ball(28) if shape == "ball" else bumps(28, generator)
    albedo = regions(28, generator)[mask].mT
    return normals[mask].mT, albedo


@pytest.mark.parametrize("shape", ["ball", "bumps"])
def test_the_relief_of_a_surface_in_few_albedos_is_found(generator, shape):
    normals, albedo = painted(generator, shape)
    b = HIDDEN.on_shading(albedo.sum(dim=0) * normals)
    assert error_deg(b, normals) > 10
    # The kernel is 1.5 % of albedo wide; an error of one degree changes it by up to 1.7 %.
    assert error_deg(resolve_by_albedo_entropy(b).on_shading(b), normals) < 1


def test_noise_and_a_second_cue_of_colour(generator):
    normals, albedo = painted(generator, "ball")
    b = albedo.sum(dim=0) * normals
    b = b + 0.01 * torch.randn(b.shape, generator=generator, dtype=torch.float64)
    b = HIDDEN.on_shading(b)
    groups = torch.unique(albedo, dim=1, return_inverse=True)[1]
    floor = error_deg(HIDDEN.inverse().on_shading(b), normals)
    found = resolve_by_albedo_entropy(b, groups).on_shading(b)
    assert error_deg(found, normals) < floor + 0.5


def test_colour_finds_what_brightness_misses():
    # Five albedos within a factor of 1.7, among which the search without colour goes astray.
    generator = torch.Generator().manual_seed(3)
    normals, mask = bumps(48, generator)
    normals, albedo = normals[mask].mT, regions(48, generator)[mask].mT
    groups = torch.unique(albedo, dim=1, return_inverse=True)[1]
    b = HIDDEN.on_shading(albedo.sum(dim=0) * normals)
    assert error_deg(resolve_by_albedo_entropy(b, groups).on_shading(b), normals) < 1


def test_the_answer_does_not_depend_on_the_relief_handed_in(generator):
    normals, albedo = painted(generator, "ball")
    b = albedo.sum(dim=0) * normals
    moved = HIDDEN.on_shading(5 * b)
    one = resolve_by_albedo_entropy(b).on_shading(b)
    other = resolve_by_albedo_entropy(moved).on_shading(moved)
    assert_close(other, 5 * one, atol=1e-6, rtol=1e-6)


def test_entropy_is_that_of_the_paints_plus_the_kernels(generator):
    normals, _ = painted(generator, "ball")
    half = normals.shape[1] // 2
    albedo = torch.ones_like(normals[0])
    albedo[:half] = 2.0
    labels = torch.zeros_like(normals[0]).long()
    stay = torch.zeros(1, 3, dtype=torch.float64)
    both = albedo_entropy(albedo * normals, labels, stay, 0.01)
    one = albedo_entropy(normals, labels, stay, 0.01)
    assert_close(both - one, torch.tensor([2.0]).double().log(), atol=5e-3, rtol=0)
    told = albedo_entropy(albedo * normals, (albedo > 1).long(), stay, 0.01)
    assert_close(told, both, atol=5e-3, rtol=0)  # joint entropy: known paints stay counted


def test_the_dtype_is_kept_and_empty_vectors_are_left_out(generator):
    normals, albedo = painted(generator, "ball")
    b = HIDDEN.on_shading(albedo.sum(dim=0) * normals)
    b[:, ::7] = 0
    b[:, 3] = torch.nan
    found = resolve_by_albedo_entropy(b.float())
    assert found.lam.dtype == torch.float32
    kept = (b != 0).any(dim=0) & b.isfinite().all(dim=0)
    assert error_deg(found.on_shading(b.float()).double()[:, kept], normals[:, kept]) < 1


def test_too_few_vectors_and_planes_are_refused():
    with pytest.raises(InputError, match="50 at least"):
        resolve_by_albedo_entropy(torch.ones(3, 49))
    with pytest.raises(InputError, match="parallel"):
        resolve_by_albedo_entropy(torch.tensor([[0.0], [0], [-1]]).expand(3, 60))
