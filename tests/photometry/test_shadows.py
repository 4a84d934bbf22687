import math

import pytest
import torch
from scenes import ball
from torch.nn.functional import normalize

from pimper_bench.scenes.procedural_meshes import join, table
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.lighting.light_field import LightField
from pimper_torch.stages.photometry.shadows import cast_shadows, cast_shadows_on_rasters

RADIUS, HEIGHT = 0.5, 1.2  # of the ball, above the plane z = 0


@pytest.fixture(scope="module")
def ball_over_plane():
    both = join(ball(RADIUS, level=5, center=(0.0, 0.0, HEIGHT)), table(8.0))
    return RayCaster(both.vertices_world, both.faces)


def point_lights(places, distant=False):
    """Return point lights at positions, or distant ones in those directions."""
    places = torch.tensor(places, dtype=torch.float64)
    distance = places.norm(dim=1)
    return LightField(
        origin=torch.zeros(3).double(),
        soft=torch.zeros(len(places), 9).double(),
        point_light=2.0 * normalize(places, dim=1),
        inverse_distance=torch.zeros_like(distance) if distant else 1 / distance,
    )


@pytest.fixture
def plane():
    """A raster on the plane with a spacing of 0.02."""
    side = torch.linspace(-2, 2, 201, dtype=torch.float64)
    y, x = torch.meshgrid(side, side, indexing="ij")
    points = torch.stack([x, y, torch.zeros_like(x)], dim=-1)
    return points, torch.tensor([0.0, 0, 1]).double().expand_as(points)


def ellipse(points, direction):
    """Approximate signed distance to the contour of the ball's shadow, light at infinity."""
    direction = normalize(torch.tensor(direction, dtype=torch.float64), dim=0)
    centre = -HEIGHT * direction[:2] / direction[2]
    along = normalize(direction[:2], dim=0)
    offset = points[..., :2] - centre
    u, v = offset @ along, offset @ torch.stack([-along[1], along[0]])
    return ((u * direction[2]) ** 2 + v**2).sqrt() - RADIUS


def test_a_distant_point_light_casts_an_elliptic_shadow_of_a_ball(ball_over_plane, plane):
    points, normals = plane
    direction = (0.5, 0.2, 0.9)
    found = cast_shadows(point_lights([direction], True), ball_over_plane, points, normals, 1e-4)
    contour = ellipse(points, direction)
    clear = contour.abs() > 0.003  # the icosphere is up to 0.0005 inside the ball
    assert clear.float().mean() > 0.98
    assert (found.lit[..., 0] == (contour > 0))[clear].all()
    assert 0.03 < (~found.lit).float().mean() < 0.2  # there is a shadow


def test_occluders_behind_the_point_light_cast_no_shadow(ball_over_plane, plane):
    found = cast_shadows(point_lights([(0, 0, HEIGHT - 0.6)]), ball_over_plane, *plane, 1e-4)
    assert found.lit.all()


def test_the_attached_shadow_of_a_ball_ends_at_the_terminator(ball_over_plane, generator):
    normals = normalize(torch.randn(2000, 3, generator=generator, dtype=torch.float64), dim=1)
    points = RADIUS * normals + torch.tensor([0, 0, HEIGHT]).double()
    direction = normalize(torch.tensor([0.3, -0.4, 0.8]).double(), dim=0)
    field = point_lights([direction.tolist()], True)
    # Points are off the faces by up to 0.0005: without a lift some would shadow themselves.
    found = cast_shadows(field, ball_over_plane, points, normals, 1e-3, guard=1e-3)
    facing = normals @ direction
    clear = facing.abs() > 0.05
    assert (found.lit[:, 0] == (facing > 0))[clear].all()
    assert found.sure[clear].all()


def test_only_samples_near_shadow_edges_are_unsure(ball_over_plane, plane):
    light_height, guard = 3.0, 0.1
    given = point_lights([(0, 0, light_height)]), ball_over_plane, *plane, 1e-4
    found, plain = cast_shadows(*given, guard=guard), cast_shadows(*given)
    edge = light_height * math.tan(math.asin(RADIUS / (light_height - HEIGHT)))
    contour = plane[0][..., :2].norm(dim=-1) - edge
    sure = found.sure[..., 0]
    near, far = contour.abs() < 0.95 * guard, contour.abs() > 1.2 * guard  # the edge is curved
    assert near.any()
    assert not sure[near].any()
    assert sure[far].all()
    assert (plain.lit[..., 0] == (contour > 0))[contour.abs() > 0.003].all()
    assert plain.sure.all()
    assert (plain.lit == found.lit).all()


def test_a_view_without_a_point_light_is_lit_everywhere(ball_over_plane, plane):
    points, normals = plane
    dark = point_lights([(0.5, 0.2, 0.9), (0, 0, 3)])
    dark = dark.replace(point_light=dark.point_light * torch.tensor([[1.0], [0.0]]))
    found = cast_shadows(dark, ball_over_plane, points, -normals, 1e-4)
    assert not found.lit[..., 0].any()
    assert found.lit[..., 1].all()


@pytest.mark.parametrize("stride", [1, 4])
def test_sparse_rays_agree_with_dense_ones_except_near_edges(ball_over_plane, plane, stride):
    points, normals = plane
    field = point_lights([(1.0, 0.4, 2.5), (-0.5, 0.2, 4.0)])
    raster = points[None, :, :150], normals[None, :, :150]  # no multiple of the stride
    spacing = torch.tensor([0.02]).double()
    seen = torch.ones(1, 2, *raster[0].shape[1:3], dtype=torch.bool)
    dense = cast_shadows(field, ball_over_plane, *raster, 1e-4)
    found = cast_shadows_on_rasters(
        field, ball_over_plane, *raster, spacing, seen, tolerance=1e-4, guard=0.02, stride=stride
    )
    assert found.lit.shape == dense.lit.shape
    assert (found.lit == dense.lit)[found.sure].all()
    assert found.sure.float().mean() > 0.85
    if stride == 1:
        assert (found.lit == dense.lit).all()


def test_rays_are_cast_only_in_views_that_show_the_sample(ball_over_plane, plane):
    points, normals = plane
    field = point_lights([(0, 0, 3.0), (0.5, 0, 3.0)])
    spacing = torch.tensor([0.02]).double()
    seen = torch.zeros(1, 2, *points.shape[:2], dtype=torch.bool)
    seen[:, 0, 90:110] = True
    seen[:, 1, :, 100:] = True
    settings = {"tolerance": 1e-4, "stride": 4, "guard": 0.01}
    raster = points[None], normals[None], spacing
    found = cast_shadows_on_rasters(field, ball_over_plane, *raster, seen, **settings)
    whole = cast_shadows_on_rasters(
        field, ball_over_plane, *raster, torch.ones_like(seen), **settings
    )
    there = seen.movedim(1, -1)
    assert (found.lit == whole.lit)[there].all()
    assert (found.sure == whole.sure)[there].all()
    assert not found.lit[there].all()
    assert found.lit[0, :80, :, 0].all()
