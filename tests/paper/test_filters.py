import torch
from torch.testing import assert_close

from pimper_torch.paper.cloud_filters import (
    behind_others,
    neighbours_agree,
    on_hull,
    spread,
    spread_to_count,
    views_near,
    well_accompanied,
)


def test_views_near_counts_from_the_optical_axis(dome_cloud):
    # Five views on an arc of 50 degrees: neighbours are about 12.5 degrees apart.
    near = views_near(dome_cloud.cameras, 2, 16.0)
    assert near.tolist() == [False, True, True, True, False]


def test_points_of_another_layer_and_stray_points_disagree_with_their_neighbours():
    generator = torch.Generator().manual_seed(1)
    lateral = torch.rand(300, 2, generator=generator, dtype=torch.float64)
    depth = 5 + 0.3 * lateral[:, 0]
    depth[:10] += 2.0  # another layer
    depth[10:20] += 0.12  # badly triangulated: several radii of a neighbourhood
    points_cam = torch.cat([lateral, depth[:, None]], dim=1)
    agree = neighbours_agree(
        lateral * 500, points_cam, neighbours=12, max_slope=3.0, max_deviation=0.5
    )
    assert not agree[:20].any()
    assert agree[20:].float().mean() > 0.98


def test_neighbours_across_a_depth_edge_agree_each_with_its_own_side():
    u, v = torch.meshgrid(torch.arange(20.0), torch.arange(20.0), indexing="xy")
    lateral = torch.stack([u, v], dim=-1).reshape(-1, 2).double()
    depth = torch.where(lateral[:, 0] < 9.5, 100.0, 160.0).double()
    points_cam = torch.cat([lateral, depth[:, None]], dim=1)
    agree = neighbours_agree(lateral, points_cam, neighbours=8, max_slope=3.0, max_deviation=0.5)
    assert agree.float().mean() > 0.95


def test_points_behind_a_layer_are_hidden_and_those_beside_its_contour_are_not():
    # A disc of radius 1 at depth 4 in front of a wall at depth 7 that ran through behind it.
    generator = torch.Generator().manual_seed(212)
    lateral = 4 * torch.rand(1500, 2, generator=generator, dtype=torch.float64) - 2
    radius = lateral.norm(dim=1)
    on_wall = (radius > 1) | (torch.rand(1500, generator=generator) < 0.3)
    depth = torch.where(on_wall, 7.0, 4.0).double()
    points_cam = torch.cat([lateral, depth[:, None]], dim=1)
    seen = torch.ones_like(on_wall)
    found = behind_others(lateral, points_cam, seen, neighbours=24, slope=3.0)
    assert found[on_wall & (radius < 0.85)].float().mean() > 0.95
    assert not found[~on_wall].any()
    assert not found[on_wall & (radius > 1.02)].any()
    # Just inside the contour they have the disc on one side only; unseen, they are doubted.
    unseen = behind_others(lateral, points_cam, ~on_wall, neighbours=24, slope=3.0)
    edge = on_wall & (radius > 0.85) & (radius < 0.99)
    assert found[edge].float().mean() < 0.8 < 0.98 < unseen[edge].float().mean()
    assert not unseen[~on_wall].any()
    assert not unseen[on_wall & (radius > 1.3)].any()


def test_no_point_of_a_steep_dome_is_hidden():
    generator = torch.Generator().manual_seed(213)
    lateral = 2 * torch.rand(2000, 2, generator=generator, dtype=torch.float64) - 1
    lateral = lateral[lateral.norm(dim=1) < 0.999]
    depth = 5 - (1 - lateral.square().sum(dim=1)).sqrt()
    points_cam = torch.cat([lateral, depth[:, None]], dim=1)
    unseen = torch.zeros(len(lateral), dtype=torch.bool)
    found = behind_others(lateral, points_cam, ~unseen, neighbours=24, slope=3.0)
    assert not found.any()
    doubted = behind_others(lateral, points_cam, unseen, neighbours=24, slope=3.0)
    assert not doubted[lateral.norm(dim=1) < 0.94].any()  # up to 70 degrees


def test_spread_keeps_its_distance_and_prefers_quality():
    generator = torch.Generator().manual_seed(2)
    pixels = 100 * torch.rand(400, 2, generator=generator, dtype=torch.float64)
    quality = torch.rand(400, generator=generator, dtype=torch.float64)
    chosen = spread(pixels, quality, 9.0)
    distance = torch.cdist(pixels[chosen], pixels[chosen]).fill_diagonal_(torch.inf)
    assert distance.min() > 9.0
    assert quality.argmax() in chosen
    # Nothing else would fit: every point is close to a chosen one that is at least as good.
    near = torch.cdist(pixels, pixels[chosen]) <= 9.0
    better = quality[chosen] >= quality[:, None]
    assert (near & better).any(dim=1).all()


def test_spread_to_count_comes_close_to_the_number():
    generator = torch.Generator().manual_seed(3)
    pixels = 100 * torch.rand(1000, 2, generator=generator, dtype=torch.float64)
    chosen = spread_to_count(pixels, torch.ones(1000, dtype=torch.float64), 60)
    assert abs(len(chosen) - 60) <= 6


def test_the_hull_holds_every_other_point():
    generator = torch.Generator().manual_seed(4)
    pixels = torch.rand(200, 2, generator=generator, dtype=torch.float64)
    corners = pixels[on_hull(pixels)]
    assert 3 <= len(corners) < 60
    # Nothing lies further out than the hull's corners, whatever the direction.
    angle = torch.linspace(0, 6.28, 100, dtype=torch.float64)
    directions = torch.stack([angle.cos(), angle.sin()])
    reach, of_corners = (pixels @ directions).amax(dim=0), (corners @ directions).amax(dim=0)
    assert_close(of_corners, reach)


def test_lonely_corners_of_the_hull_are_dropped_shell_by_shell_and_no_inner_point():
    generator = torch.Generator().manual_seed(7)
    pixels = torch.rand(300, 2, generator=generator, dtype=torch.float64)
    pixels[0] = torch.tensor([3.0, 3.0])
    pixels[1] = torch.tensor([2.0, 2.5])  # in the first one's shadow until that is gone
    kept = well_accompanied(pixels, 3.0)
    assert not kept[:2].any()
    assert kept[2:].float().mean() > 0.97
