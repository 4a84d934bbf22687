import pytest
import torch
from reliefs import WavyPlane
from torch.testing import assert_close

from pimper_bench.scenes.render_in_memory import EndlessPlane, Sphere
from pimper_bench.scenes.textures import random_waves


def rays_from_above(generator, count=500):
    origins = torch.rand(count, 3, generator=generator, dtype=torch.float64) * 2 - 1
    origins[:, 2] += 4
    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64) * 0.15
    directions[:, 2] -= 1.5
    return origins, directions


def waves(generator):
    return random_waves(generator, wavelength=1.5, root_mean_square=0.05, axes=2)


LEVELS = {
    "sphere": lambda p: p.norm(dim=-1) - 1,
    "plane": lambda p: p @ p.new_tensor([0.2, -0.1, 1.0]) - 0.3,
}
SHAPES = {
    "sphere": Sphere(),
    "plane": EndlessPlane(point=(0.0, 0.0, 0.3), normal=(0.2, -0.1, 1.0)),
}


@pytest.mark.parametrize("name", SHAPES)
def test_a_hit_is_the_first_point_on_the_surface(name, generator):
    origins, directions = rays_from_above(generator)
    distance = SHAPES[name].intersect(origins, directions)
    hit = distance.isfinite()
    assert hit.sum() > 100
    points = (origins + distance[:, None] * directions)[hit]
    level = LEVELS[name]
    assert_close(level(points), torch.zeros(len(points), dtype=torch.float64), atol=1e-12, rtol=0)
    for fraction in (0.3, 0.7, 0.99):
        before = (origins + fraction * distance[:, None] * directions)[hit]
        assert (level(before) > 0).all()


@pytest.mark.parametrize("name", SHAPES)
def test_normals_are_the_gradient_of_the_level_and_unit(name, generator):
    origins, directions = rays_from_above(generator)
    distance = SHAPES[name].intersect(origins, directions)
    hit = distance.isfinite()
    points = (origins + distance[:, None] * directions)[hit].requires_grad_()
    (gradient,) = torch.autograd.grad(LEVELS[name](points).sum(), points)
    expected = gradient / gradient.norm(dim=-1, keepdim=True)
    assert_close(SHAPES[name].normals(points.detach()), expected, atol=1e-12, rtol=0)


def test_rays_past_a_sphere_or_away_from_a_plane_have_no_hit():
    origins = torch.tensor([[0.0, 0.0, 4.0], [2.0, 0.0, 4.0]], dtype=torch.float64)
    directions = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    assert Sphere().intersect(origins, directions).isinf().all()
    assert EndlessPlane().intersect(origins[:1], directions[:1]).isinf().all()


def test_a_ray_from_inside_a_sphere_hits_its_far_side():
    origin = torch.zeros(1, 3, dtype=torch.float64)
    direction = torch.tensor([[0.0, 2.0, 0.0]], dtype=torch.float64)
    assert_close(Sphere(radius=3.0).intersect(origin, direction), torch.tensor([1.5]).double())


def test_bumps_are_hit_on_the_height_field_with_its_normals(generator):
    height_field = waves(generator)
    shape = WavyPlane(height_field=height_field)
    origins, directions = rays_from_above(generator)
    points = origins + shape.intersect(origins, directions)[:, None] * directions
    assert points[:, 2].std() > 0.02  # otherwise a plane would pass
    assert_close(points[:, 2], height_field(points[:, :2]), atol=1e-12, rtol=0)
    xy = points[:, :2].clone().requires_grad_()
    (slope,) = torch.autograd.grad(height_field(xy).sum(), xy)
    tangent_x = torch.stack([torch.ones(len(xy)), torch.zeros(len(xy)), slope[:, 0]], dim=1)
    tangent_y = torch.stack([torch.zeros(len(xy)), torch.ones(len(xy)), slope[:, 1]], dim=1)
    expected = torch.linalg.cross(tangent_x, tangent_y)
    expected = expected / expected.norm(dim=1, keepdim=True)
    assert_close(shape.normals(points), expected, atol=1e-12, rtol=0)
