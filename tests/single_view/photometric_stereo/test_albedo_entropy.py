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
from tests.single_view.scenes import angles_deg

HIDDEN = BasRelief(
    mu=torch.tensor(0.7).double(), nu=torch.tensor(-0.4).double(), lam=torch.tensor(1.6).double()
)


def painted(shape, size=28, seed=1):
    """Return normals, shading vectors and the albedo index of each pixel."""
    generator = torch.Generator().manual_seed(seed)
    normals, mask = ball(size) if shape == "ball" else bumps(size, generator)
    normals, albedo = normals[mask].mT, regions(size, generator)[mask].mT
    groups = torch.unique(albedo, dim=1, return_inverse=True)[1]
    return normals, albedo.sum(dim=0) * normals, groups


def off_deg(b, normals, groups=None):
    return angles_deg(resolve_by_albedo_entropy(b, groups).on_shading(b), normals).mean()


@pytest.mark.parametrize("shape", ["ball", "bumps"])
def test_the_relief_of_a_surface_with_few_albedos_is_recovered(shape):
    normals, shading, _ = painted(shape)
    b = HIDDEN.on_shading(shading)
    assert angles_deg(b, normals).mean() > 10
    # The kernel is 1.5 % of albedo wide; an error of one degree changes it by up to 1.7 %.
    assert off_deg(b, normals) < 1


def test_the_relief_is_recovered_under_noise_and_with_colour(generator):
    normals, shading, groups = painted("ball")
    noise = torch.randn(shading.shape, generator=generator, dtype=torch.float64)
    noisy = shading + 0.01 * noise
    floor = angles_deg(noisy, normals).mean()
    assert off_deg(HIDDEN.on_shading(noisy), normals, groups) < floor + 0.5


def test_colour_determines_the_relief_where_brightness_fails():
    # Five albedos within a factor of 1.7: the search without colour finds a wrong minimum.
    normals, shading, groups = painted("bumps", size=48, seed=3)
    assert off_deg(HIDDEN.on_shading(shading), normals, groups) < 1


def test_the_result_does_not_depend_on_the_initial_relief():
    _, b, _ = painted("ball")
    moved = HIDDEN.on_shading(5 * b)
    one = resolve_by_albedo_entropy(b).on_shading(b)
    other = resolve_by_albedo_entropy(moved).on_shading(moved)
    assert_close(other, 5 * one, atol=1e-6, rtol=1e-6)


def test_entropy_is_that_of_the_albedos_plus_that_of_the_kernel():
    normals, _, _ = painted("ball")
    albedo = torch.ones_like(normals[0])
    albedo[: len(albedo) // 2] = 2.0
    labels, stay = torch.zeros_like(albedo).long(), torch.zeros(1, 3, dtype=torch.float64)
    both = albedo_entropy(albedo * normals, labels, stay, 0.01)
    one = albedo_entropy(normals, labels, stay, 0.01)
    assert_close(both - one, torch.tensor([2.0]).double().log(), atol=5e-3, rtol=0)
    joint = albedo_entropy(albedo * normals, (albedo > 1).long(), stay, 0.01)
    assert_close(joint, both, atol=5e-3, rtol=0)  # known labels still count in joint entropy


def test_the_dtype_is_kept_and_empty_vectors_are_ignored():
    normals, shading, _ = painted("ball")
    b = HIDDEN.on_shading(shading).float()
    b[:, ::7], b[:, 3] = 0, torch.nan
    found = resolve_by_albedo_entropy(b)
    assert found.lam.dtype == torch.float32
    kept = (b != 0).any(dim=0) & b.isfinite().all(dim=0)
    assert angles_deg(found.on_shading(b).double()[:, kept], normals[:, kept]).mean() < 1


@pytest.mark.parametrize(
    ("shading", "needed"),
    [
        (torch.ones(3, 49), "at least 50"),
        (torch.tensor([[0.0], [0], [-1]]).expand(3, 60), "parallel"),
    ],
)
def test_too_few_vectors_and_planes_are_rejected(shading, needed):
    with pytest.raises(InputError, match=needed):
        resolve_by_albedo_entropy(shading)
