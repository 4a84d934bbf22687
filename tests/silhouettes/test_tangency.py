import torch
from torch.nn.functional import normalize

from pimper_bench.metrics.in_view import angles_deg
from pimper_torch.geometry.contours import ambiguous, contour_points, contour_rays
from pimper_torch.geometry.visual_hull import visual_hull
from tests.silhouettes.shapes import CENTERS, DISTANCE, PIXEL, ball, ring, silhouettes_of, two_balls

BOX = torch.tensor([[-1.6, -1.6, -1.6], [1.6, 1.6, 1.6]])


def directions(count):
    generator = torch.Generator().manual_seed(5)
    return normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1)


def touched(shape, cameras, points, normals):
    silhouettes = silhouettes_of(shape, cameras)
    hull = visual_hull(silhouettes, cameras.to(torch.float32), BOX, num_voxels=64**3)
    assert hull is not None
    rays = contour_rays(silhouettes, cameras)
    return rays, contour_points(rays, cameras, hull, points, normals)


def test_contour_points_of_a_ball_are_its_contour(cameras):
    # No ray meets a ball of half its radius, but the nearest point is still correct.
    for radius in (1.0, 0.5):
        towards = directions(2000)
        rays, found = touched(ball, cameras, radius * towards, towards)
        assert len(found.ray) > 0.95 * len(rays.view)
        centers = cameras.centers_world[found.view]
        # On the contour the radius is perpendicular to the ray: points . center = 1. Within 4
        # pixels of it a ray leaves this ball by a fifth of a pixel, as accurate as its mask.
        along = ((found.points_world * centers).sum(dim=1) - 1) / DISTANCE
        assert along.abs().mean() < 4 * PIXEL
        assert ball(found.points_world).abs().mean() < 0.3 * PIXEL
        assert angles_deg(found.normals_world, normalize(found.points_world, dim=1)).mean() < 4
        assert bool((found.view == rays.view[found.ray]).all())
        sigma = rays.sigma_px[found.ray] * PIXEL
        assert ((found.variance.sqrt() / sigma - 1).abs() < 0.3).all()  # depths from 4 to 6


def test_contour_points_of_a_ring_are_on_it_even_inside_its_hole(cameras):
    rotation, roll = (
        2 * torch.pi * torch.rand(2, 4000, generator=torch.Generator().manual_seed(2)).double()
    )
    outward = torch.stack(
        [rotation.cos() * roll.cos(), rotation.sin() * roll.cos(), roll.sin()], dim=1
    )
    core = 0.9 * torch.stack([rotation.cos(), rotation.sin(), torch.zeros_like(rotation)], dim=1)
    rays, found = touched(ring, cameras, core + 0.35 * outward, outward)
    assert len(found.ray) > 0.9 * len(rays.view)
    assert ring(found.points_world).abs().quantile(0.95) < 1.5 * PIXEL
    inner = found.points_world[:, :2].norm(dim=1) < 0.7
    assert inner.sum() > 0.07 * len(inner)
    away = found.points_world - 0.9 * normalize(
        found.points_world * torch.tensor([1.0, 1.0, 0.0]).double(), dim=1
    )
    angles = angles_deg(found.normals_world, normalize(away, dim=1))
    assert angles.median() < 4
    assert angles.quantile(0.95) < 15


def test_no_contour_point_is_between_overlapping_balls(cameras):
    towards = directions(1500)
    points = torch.cat([center + 0.5 * towards for center in CENTERS])
    rays, found = touched(two_balls, cameras, points, towards.repeat(2, 1))
    assert len(found.ray) > 0.9 * len(rays.view)
    assert two_balls(found.points_world).abs().max() < 2 * PIXEL
    away = found.points_world[:, None] - CENTERS
    which = away.norm(dim=-1).argmin(dim=1)
    own = away[torch.arange(len(which)), which]
    assert angles_deg(found.normals_world, normalize(own, dim=1)).quantile(0.99) < 20


def test_a_ray_close_to_two_surfaces_abstains(cameras):
    inf = torch.inf
    cost = torch.tensor(
        [
            [inf, 5.0, 1.0, 0.2, 1.0, 5.0, inf, 5.0],  # one
            [5.0, 0.1, 5.0, 5.0, 0.3, 5.0, inf, inf],  # two with a rise in between
            [inf, 0.1, inf, inf, 0.3, inf, inf, inf],  # two, the hull ends in between
            [5.0, 0.1, 5.0, 5.0, 2.0, 5.0, inf, inf],  # the second is farther
            [5.0, 0.1, 0.9, 1.2, 0.3, 5.0, inf, inf],  # one, hardly curved
            [5.0, -3.0, 5.0, 5.0, -1.0, 5.0, inf, inf],  # below both
        ]
    )
    found = ambiguous(cost, torch.full((6,), 1.0))
    assert found.tolist() == [False, True, True, False, False, True]


def test_contour_points_beyond_a_partial_surface_are_not_below_it(cameras):
    towards = directions(6000)
    cap = towards[towards[:, 2] > 0.6]
    rays, found = touched(ball, cameras, cap, cap)
    # Far from the cap, rays only have the hull, which is the ball plus corners.
    assert len(found.ray) > 0.8 * len(rays.view)
    assert ball(found.points_world).abs().max() < 0.35
    near = found.points_world[:, 2] > 0.6
    assert ball(found.points_world[near]).abs().mean() < 0.5 * PIXEL


def test_rays_that_miss_the_hull_have_no_point(cameras):
    silhouettes = silhouettes_of(ball, cameras)
    hull = visual_hull(silhouettes, cameras.to(torch.float32), BOX, num_voxels=32**3)
    assert hull is not None
    rays = contour_rays(silhouettes, cameras)
    beside = rays.replace(rays_world=rays.rays_world + 0.2 * rays.normals_world)
    towards = directions(500)
    assert len(contour_points(beside, cameras, hull, towards, towards).ray) == 0
