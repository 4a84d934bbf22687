import pytest
import torch
from draws import uniform
from torch.testing import assert_close

from pimper_torch.geometry.projection import project
from pimper_torch.geometry.surfaces import face_normals, side_lengths
from pimper_torch.geometry.topology import face_components, half_edges
from pimper_torch.paper.cloud_filters import (
    consistent_points,
    delaunay,
    facets_under,
    occluded_points,
    on_hull,
    spread,
    spread_to_count,
    without_isolated_corners,
)
from pimper_torch.paper.paper_config import TriangulateConfig
from pimper_torch.paper.triangulate import Triangulate, peel
from pimper_torch.runtime.errors import ReconstructionError


def test_the_mesh_of_a_ball_is_an_outward_disc_on_the_ball(dome_cloud):
    coarse = Triangulate(TriangulateConfig(num_points=120))(dome_cloud)
    vertices, faces = coarse.mesh.vertices_world, coarse.mesh.faces
    assert 80 <= len(vertices) <= 140
    outward = (face_normals(vertices, faces) * vertices[faces].mean(dim=1)).sum(dim=-1)
    assert (outward > 0).all()
    assert (face_components(faces) == 0).all()
    assert (vertices.norm(dim=-1) - 1).abs().max() < 0.01
    cosine = (coarse.mesh.normals_world * vertices).sum(dim=-1)
    assert torch.rad2deg(cosine.clamp(-1, 1).acos()).mean() < 8
    edges = half_edges(faces).sort(dim=1).values
    unique, counts = torch.unique(edges, dim=0, return_counts=True)
    assert counts.max() == 2
    assert len(vertices) - len(unique) + len(faces) == 1


def test_the_coarse_mesh_keeps_attributes_of_its_points(dome_cloud):
    coarse = Triangulate(TriangulateConfig(num_points=60))(dome_cloud)
    vertices, points = coarse.mesh.vertices_world, coarse.points
    assert coarse.is_point.all()
    assert coarse.covariance_world.shape == (len(vertices), 3, 3)
    assert len(points.facet) > 100
    # They exclude vertices, and each is on its facet: close to its plane on a mesh so smooth.
    assert torch.cdist(points.points_world, vertices).min() > 0
    corners = vertices[coarse.mesh.faces[points.facet]]
    away = (points.points_world[:, None] - corners).norm(dim=-1).amax(dim=1)
    assert (away < 1.1 * side_lengths(corners).amax(dim=1)).all()


def test_outliers_do_not_become_vertices(dome_cloud):
    moved = dome_cloud.points_world.clone()
    moved[::15] *= 1 + 0.4 * torch.rand(
        len(moved[::15]), 1, generator=torch.Generator().manual_seed(5)
    )
    coarse = Triangulate()(dome_cloud.replace(points_world=moved))
    assert (coarse.mesh.vertices_world.norm(dim=-1) - 1).abs().max() < 0.05


def test_facets_outside_the_masks_are_peeled_from_the_boundary(dome_cloud):
    masks = dome_cloud.views.inside.clone()
    masks[..., :80] = False  # the left half of every photograph
    peeled = Triangulate()(dome_cloud.replace(views=dome_cloud.views.replace(masks=masks)))
    centers = peeled.mesh.vertices_world[peeled.mesh.faces].mean(dim=1)
    view, cameras = peeled.reference, dome_cloud.cameras
    pixels, _ = project(centers, cameras.cam_from_world[view], cameras.intrinsics[view])
    assert pixels[:, 0].min() > 70
    assert len(peeled.mesh.faces) < 0.75 * len(Triangulate()(dome_cloud).mesh.faces)


def test_bridges_over_a_depth_discontinuity_are_dropped(dome_cloud):
    step = dome_cloud.points_world.clone()
    # Flatten the ball to two levels with a cliff at x = 0 that no facet may span.
    step[:, 2] = torch.where(step[:, 0] < 0, 0.0, 1.0)
    exact = torch.zeros_like(step[:, 0])
    coarse = Triangulate()(dome_cloud.replace(points_world=step, reprojection_errors_px=exact))
    levels = coarse.mesh.vertices_world[coarse.mesh.faces][..., 2]
    assert (levels.amax(dim=1) - levels.amin(dim=1) < 0.5).all()


def test_a_cloud_without_reliable_points_is_rejected_with_counts(dome_cloud):
    bad = dome_cloud.replace(reprojection_errors_px=100 + 0 * dome_cloud.reprojection_errors_px)
    with pytest.raises(ReconstructionError, match=r"0 of \d+ sparse points are reliable and seen"):
        Triangulate()(bad)


def test_peeling_opens_no_hole():
    grid = torch.cartesian_prod(torch.arange(5.0), torch.arange(5.0)).double()
    faces = delaunay(grid + 0.01 * torch.sin(7 * grid.flip(1)))
    blunt = torch.zeros_like(faces, dtype=torch.bool)
    centers = grid[faces].mean(dim=1)
    inner = (centers - 2).abs().amax(dim=1) < 0.7
    assert len(peel(faces, inner, blunt)) == len(faces)
    assert len(peel(faces, centers[:, 0] < 1, blunt)) < len(faces)


@pytest.mark.parametrize(("sharp", "left"), [(2, 2), (0, 3)])
def test_spikes_are_dropped_and_blunt_ears_stay(sharp, left):
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [2, 1, 4]])  # a square, and an ear with tip 4
    corners = torch.zeros_like(faces, dtype=torch.bool)
    corners[2, sharp] = True
    found = peel(faces, torch.zeros(3, dtype=torch.bool), corners)
    assert found.tolist() == faces[:left].tolist()


def test_facets_under_points_of_an_image():
    corners = torch.tensor([[[0.0, 0], [2, 0], [0, 2]], [[2, 0], [2, 2], [0, 2]]])
    pixels = torch.tensor([[0.5, 0.5], [1.7, 1.7], [3.0, 1.0], [0.1, 1.0]])
    assert facets_under(pixels, corners).tolist() == [0, 1, -1, 0]


def test_points_of_a_different_layer_and_stray_points_disagree_with_neighbours(generator):
    lateral = uniform(generator, 300, 2)
    depth = 5 + 0.3 * lateral[:, :1]
    depth[:10] += 2.0  # another layer
    depth[10:20] += 0.12  # badly triangulated, by several radii of a neighbourhood
    points_cam = torch.cat([lateral, depth], dim=1)
    agree = consistent_points(lateral * 500, points_cam, max_slope=3.0)
    assert not agree[:20].any()
    assert agree[20:].float().mean() > 0.98


def test_points_at_a_depth_edge_agree_with_their_own_side():
    lateral = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)).double()
    depth = torch.where(lateral[:, :1] < 9.5, 100.0, 160.0).double()
    points_cam = torch.cat([lateral, depth], dim=1)
    agree = consistent_points(lateral, points_cam, neighbours=8, max_slope=3.0)
    assert agree.float().mean() > 0.95


def test_points_behind_a_layer_are_hidden_but_not_outside_its_contour(generator):
    # A disc of radius 1 at depth 4 in front of a wall at depth 7 that continues behind it.
    lateral = 4 * uniform(generator, 1500, 2) - 2
    radius = lateral.norm(dim=1)
    on_wall = (radius > 1) | (uniform(generator, 1500) < 0.3)
    depth = torch.where(on_wall, 7.0, 4.0).double()
    points_cam = torch.cat([lateral, depth[:, None]], dim=1)
    found = occluded_points(lateral, points_cam, torch.ones_like(on_wall))
    assert found[on_wall & (radius < 0.85)].float().mean() > 0.95
    assert not found[~on_wall].any()
    assert not found[on_wall & (radius > 1.02)].any()
    # Just inside the contour, the disc is on one side only; unseen points are suspect.
    unseen = occluded_points(lateral, points_cam, ~on_wall)
    edge = on_wall & (radius > 0.85) & (radius < 0.99)
    assert found[edge].float().mean() < 0.8 < 0.98 < unseen[edge].float().mean()
    assert not unseen[~on_wall].any()
    assert not unseen[on_wall & (radius > 1.3)].any()


@pytest.mark.parametrize(("seen", "reach"), [(True, 1.0), (False, 0.94)])  # 0.94: 70 degrees
def test_no_point_of_a_steep_dome_is_hidden(generator, seen, reach):
    lateral = 2 * uniform(generator, 2000, 2) - 1
    lateral = lateral[lateral.norm(dim=1) < 0.999]
    depth = 5 - (1 - lateral.square().sum(dim=1, keepdim=True)).sqrt()
    observed = torch.full_like(lateral[:, 0], seen, dtype=torch.bool)
    found = occluded_points(lateral, torch.cat([lateral, depth], dim=1), observed)
    assert not found[lateral.norm(dim=1) < reach].any()


def test_spread_points_keep_their_distance_and_the_best_are_chosen_first(generator):
    pixels, quality = 100 * uniform(generator, 400, 2), uniform(generator, 400)
    chosen = spread(pixels, quality, 9.0)
    assert torch.cdist(pixels[chosen], pixels[chosen]).fill_diagonal_(torch.inf).min() > 9.0
    assert quality.argmax() in chosen
    # The choice is maximal: every point is close to a chosen one that is at least as good.
    near = torch.cdist(pixels, pixels[chosen]) <= 9.0
    better = quality[chosen] >= quality[:, None]
    assert (near & better).any(dim=1).all()
    assert abs(len(spread_to_count(pixels, torch.ones(400).double(), 60)) - 60) <= 6


def test_the_hull_contains_every_other_point(generator):
    pixels = uniform(generator, 200, 2)
    corners = pixels[on_hull(pixels)]
    assert 3 <= len(corners) < 60
    # No point is further out than the corners of the hull, in any direction.
    angle = torch.linspace(0, 6.28, 100, dtype=torch.float64)
    directions = torch.stack([angle.cos(), angle.sin()])
    assert_close((corners @ directions).amax(dim=0), (pixels @ directions).amax(dim=0))


def test_lonely_corners_of_the_hull_are_dropped_shell_by_shell_and_no_inner_point(generator):
    pixels = uniform(generator, 300, 2)
    pixels[0] = torch.tensor([3.0, 3.0])
    pixels[1] = torch.tensor([2.0, 2.5])  # shielded by the first one until that is removed
    kept = without_isolated_corners(pixels)
    assert not kept[:2].any()
    assert kept[2:].float().mean() > 0.97
