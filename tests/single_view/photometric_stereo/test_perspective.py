import pytest
import torch
from one_view import photograph, point_lights
from reliefs import bumps_in_perspective, regions
from torch.autograd.functional import jvp
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.scenes.render_in_memory import Sphere
from pimper_torch.geometry.pixels import homogeneous, pixel_centers
from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.photometric_stereo.perspective import (
    factorize_in_perspective,
    integrability_equations,
)
from tests.single_view.scenes import angles_deg


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(1)


def seen_in_perspective(generator, noise=0.0, widest_deg=30.0, steepest=1.0):
    normals, mask, intrinsics, _ = bumps_in_perspective(64, generator, steepest=steepest)
    lights = point_lights(12, generator, widest_deg)
    made = photograph(normals, regions(64, generator), mask, lights, generator, noise)
    return made, intrinsics


def off_deg(found, true):
    return angles_deg(found, true).mean()


def lit(made):
    values = made.images.sum(dim=1)[:, made.mask]
    return values > 0.03 * values.max()


def test_equations_vanish_on_normals_of_a_surface(generator):
    # z = exp(f), f = 0.3 x + 0.2 x y - 0.4 y^2 + 0.3 x^3 + 0.2 y^3; see bumps_in_perspective.
    x, y = torch.rand(2, 40, generator=generator, dtype=torch.float64) - 0.5

    def normal(x, y):
        fx, fy = 0.3 + 0.2 * y + 0.9 * x * x, 0.2 * x - 0.8 * y + 0.6 * y * y
        return (1 + x * x) * torch.stack([fx, fy, -1 - x * fx - y * fy])

    one = torch.ones_like(x)
    _, along_x = jvp(normal, (x, y), (one, 0 * one))
    _, along_y = jvp(normal, (x, y), (0 * one, one))
    matrix = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    hidden = [torch.linalg.solve(matrix, v) for v in (normal(x, y), along_x, along_y)]
    rows = integrability_equations(*hidden, torch.stack([x, y, one]))
    cofactors = torch.linalg.inv(matrix).mT.flatten()
    assert_close(rows @ cofactors, 0 * x, atol=1e-12, rtol=0)
    values = torch.linalg.svdvals(rows)
    assert values[-1] < 1e-10 < 1e-4 < values[-2]  # the solution is unique


@pytest.mark.parametrize("steepest", [1.0, -1.0])
def test_convex_and_concave_surfaces_are_recovered_up_to_scale(generator, steepest):
    made, intrinsics = seen_in_perspective(generator, steepest=steepest)
    shading, lights = factorize_in_perspective(made.images, made.mask, intrinsics)
    # The remaining error is due to fifth derivatives over windows of seven pixels.
    assert off_deg(shading, made.normals) < 0.2
    assert off_deg(lights.mT, made.lights.mT) < 0.2
    factor = made.lights.square().sum(dim=1).mean().sqrt()
    assert_close(shading, factor * made.shading, rtol=0.02, atol=0.02)
    assert_close(lights @ shading, made.images.sum(dim=1)[:, made.mask], atol=1e-10, rtol=0)


def test_a_ball_has_two_solutions_and_is_rejected(generator):
    size, focal = 64, 88.0
    intrinsics = torch.tensor([[focal, 0, 32], [0, focal, 32], [0, 0, 1]]).double()
    rays = homogeneous((pixel_centers(size, size, intrinsics) - 32) / focal)
    ball = Sphere(center=(0.0, 0.0, 3.2))
    depth = ball.intersect(torch.zeros_like(rays), rays)
    mask = depth < 2.9
    normals = ball.normals(torch.where(mask, depth, 1)[..., None] * rays)
    lights = point_lights(12, generator, 30.0)
    made = photograph(normals, regions(size, generator), mask, lights, generator, 0.002)
    with pytest.raises(InputError, match="second surface"):
        factorize_in_perspective(made.images, mask, intrinsics, lit(made))


def test_shadows_are_ignored(generator):
    made, intrinsics = seen_in_perspective(generator, widest_deg=65.0)
    seen = lit(made)
    assert 0.02 < 1 - seen.double().mean() < 0.5
    shading, lights = factorize_in_perspective(made.images, made.mask, intrinsics, seen)
    assert off_deg(shading, made.normals) < 0.3
    dark = made.images.sum(dim=1)[:, made.mask][~seen]
    assert ((lights @ shading)[~seen] - dark).min() < -0.1  # the product is negative there


def test_noise_of_half_a_per_cent_is_tolerated(generator):
    made, intrinsics = seen_in_perspective(generator, noise=0.005)
    shading, _ = factorize_in_perspective(made.images, made.mask, intrinsics, radius=4)
    # Noise of the pixels costs 0.5 degrees; perspective of 40 degrees is a weak cue.
    assert off_deg(shading, made.normals) < 3


def test_non_square_and_skewed_pixels_are_supported(generator):
    # The same image in a different camera: only the rays of its pixels change.
    made, intrinsics = seen_in_perspective(generator)
    change = torch.tensor([[1.0, 0.2, 3.0], [0.0, 0.7, -5.0], [0.0, 0.0, 1.0]]).double()
    # Rays K^-1 u of the new camera are change^-1 of the old; normals transform by its transpose.
    rotated = normalize(change.mT @ made.normals, dim=0)
    assert off_deg(rotated, made.normals) > 1
    shading, _ = factorize_in_perspective(made.images, made.mask, intrinsics @ change)
    # Lights transform by the inverse, so images are unchanged: the truth for the new camera.
    assert off_deg(shading, rotated) < 0.2


def test_the_dtype_is_kept_and_pixels_with_few_views_are_ignored(generator):
    made, intrinsics = seen_in_perspective(generator)
    seen = torch.ones(12, made.normals.shape[1], dtype=torch.bool)
    seen[2:, 100] = False
    images = made.images.float()
    shading, lights = factorize_in_perspective(images, made.mask, intrinsics.float(), seen)
    assert shading.dtype == lights.dtype == torch.float32
    assert (shading[:, 100] == 0).all()
    kept = torch.arange(shading.shape[1]) != 100
    assert off_deg(shading[:, kept].double(), made.normals[:, kept]) < 0.2


THIN = (torch.arange(64) % 2 == 0)[:, None].expand(64, 64)
THREE = (torch.arange(12) < 3)[:, None].expand(12, 64**2)


@pytest.mark.parametrize(
    ("change", "needed"),
    [
        (lambda images, mask, K: (images[:2], mask, K), "2 views"),
        (lambda images, mask, K: (images, mask, -K), "focal lengths"),
        (lambda images, _, K: (images, THIN, K), "squares of 7 x 7"),
        (lambda images, mask, K: (images[:1].expand(5, -1, -1, -1), mask, K), "rank 2"),
        (lambda images, mask, K: (images, mask, K, THREE), "0 pixels more than 3"),
    ],
)
def test_inconsistent_input_is_rejected(generator, change, needed):
    made, intrinsics = seen_in_perspective(generator)
    with pytest.raises(InputError, match=needed):
        factorize_in_perspective(*change(made.images, made.mask, intrinsics))
