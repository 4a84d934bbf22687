import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_bench.metrics.in_view import angles_deg
from pimper_torch.geometry.contours import contour_rays
from tests.silhouettes.shapes import PIXEL, ball, nearest_to, ring, silhouettes_of


@pytest.fixture(scope="module")
def of_ball(cameras):
    return contour_rays(silhouettes_of(ball, cameras), cameras)


def test_rays_of_a_ball_are_tangent_with_its_normals(of_ball, cameras):
    centers = cameras.centers_world[of_ball.view]
    along = normalize(of_ball.rays_world, dim=1)
    touching = centers - (centers * along).sum(dim=1, keepdim=True) * along
    off_px = (touching.norm(dim=1) - 1) / PIXEL
    # Borders of masks have an error of a pixel; smoothing reduces it to an eighth.
    assert off_px.abs().mean() < 0.15
    assert off_px.mean().abs() < 0.08
    angles = angles_deg(of_ball.normals_world, normalize(touching, dim=1))
    assert angles.mean() < 1.5
    assert angles.max() < 4


def test_normals_are_perpendicular_to_their_rays(of_ball):
    assert_close(
        (of_ball.normals_world * of_ball.rays_world).sum(dim=1),
        torch.zeros(len(of_ball.view), dtype=torch.float64),
    )
    assert_close(of_ball.normals_world.norm(dim=1), torch.ones_like(of_ball.sigma_px))


def test_the_inner_silhouette_of_a_ring_faces_into_its_hole(cameras):
    above = torch.tensor([cameras.centers_world[:, 2].argmax()])
    silhouettes = silhouettes_of(ring, cameras)
    only = torch.zeros_like(silhouettes.reliable)
    only[above] = True
    rays = contour_rays(silhouettes.replace(reliable=only), cameras)
    assert bool((rays.view == above).all())
    centers = cameras.centers_world[rays.view]
    _, touching = nearest_to(ring, centers, rays.rays_world)
    inner = touching[:, :2].norm(dim=1) < 0.8
    assert 0.2 * len(inner) < inner.sum() < 0.8 * len(inner)
    inward = (rays.normals_world[:, :2] * touching[:, :2]).sum(dim=1) < 0
    assert bool((inward == inner).all())


def test_the_variance_of_rays_follows_soft_silhouettes(cameras):
    hard = silhouettes_of(ball, cameras)
    u = torch.arange(120, dtype=torch.float64)
    places = torch.distributions.Normal(60.0, 2.5).cdf(u).expand(20, 100, 120)
    rays = contour_rays(hard.replace(inside=places), cameras)
    assert_close(rays.pixels[:, 0], torch.full_like(rays.sigma_px, 60.5), atol=0.05, rtol=0)
    # 2.5 px, plus the error of a pixel
    assert_close(rays.sigma_px, torch.full_like(rays.sigma_px, 2.52), atol=0.1, rtol=0)
    assert contour_rays(hard, cameras).sigma_px.median() < 0.4


def test_borders_specks_corners_and_untrusted_views_have_no_rays(cameras):
    blank = silhouettes_of(ball, cameras)
    inside = torch.zeros_like(blank.inside)
    inside[:, :50, 40:80] = 1  # truncated at the top
    inside[:, 70:73, 100:103] = 1  # a speck
    rays = contour_rays(blank.replace(inside=inside, reliable=blank.reliable & False), cameras)
    assert len(rays.view) == 0
    reliable = blank.reliable.clone()
    reliable[1:] = False
    rays = contour_rays(blank.replace(inside=inside, reliable=reliable), cameras)
    u, v = rays.pixels.unbind(dim=1)
    assert bool((v >= 3).all())
    assert float(u.max()) < 90
    for corner in (40.0, 80.0):  # 90 degrees: just allowed, with tangents in between
        assert ((u - corner).abs() < 1).sum() > 30
    concave = torch.zeros_like(inside)
    concave[:, 20:80, 30:90] = 1
    concave[:, 20:50, 30:60] = 0
    rays = contour_rays(blank.replace(inside=concave, reliable=reliable), cameras)
    from_corner = (rays.pixels - torch.tensor([60.0, 50.0]).double()).norm(dim=1)
    assert from_corner.min() > 3
    assert from_corner.min() < 8


def test_the_number_of_rays_is_that_requested(cameras):
    silhouettes = silhouettes_of(ball, cameras)
    rays = contour_rays(silhouettes, cameras, 50)
    count = torch.bincount(rays.view)
    assert bool(((count >= 45) & (count <= 51)).all())


def test_any_number_of_rays_stays_on_the_contour(cameras):
    found = silhouettes_of(ball, cameras)
    for asked in (31, 62):
        assert len(contour_rays(found, cameras, asked).view) > 0
