import torch

from pimper_torch.geometry.projection import project
from pimper_torch.stages.sfm.track_observations import (
    evenly,
    plane_homographies,
    plane_normals,
    tangent_planes,
)
from tests.sfm import ball


def test_normals_of_points_on_a_ball_are_its_radii(generator):
    points = ball.points_on_the_ball(600, generator)
    towards = torch.tensor([0.0, 0, -1]).double().expand_as(points)
    found = plane_normals(points, towards)
    assert torch.rad2deg((found * points).sum(-1).clamp(-1, 1).acos()).median() < 2


def test_an_isolated_or_edge_on_point_faces_the_cameras(generator):
    wall = torch.rand(50, 3, generator=generator, dtype=torch.float64)
    wall[:, 0] = 0  # its normal is x
    towards = torch.tensor([0.0, 0, -1]).double().expand_as(wall)
    assert torch.equal(plane_normals(wall, towards), towards)
    assert torch.equal(plane_normals(wall[:1], towards[:1]), towards[:1])


def test_steps_are_in_the_plane_and_about_a_pixel_of_the_reference(generator):
    cameras = ball.cameras_on_an_arc()
    points = ball.points_on_the_ball(300, generator)
    planes = tangent_planes(points, torch.ones(len(points), 6, dtype=torch.bool), cameras)
    first, second = planes.steps_world.unbind(dim=1)
    assert (first * second).sum(-1).abs().max() < 1e-12
    moved, _ = project(
        (points[:, None] + planes.steps_world).flatten(0, 1),
        cameras.cam_from_world,
        cameras.intrinsics,
    )
    centre, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    sides = moved.reshape(6, -1, 2, 2) - centre[:, :, None]
    sides = sides[planes.reference, torch.arange(len(points))]
    area = torch.linalg.det(sides).abs()
    assert ((area > 0.7) & (area < 1.3)).all()


def test_the_reference_is_a_view_that_sees_the_point_and_never_a_candidate(generator):
    cameras = ball.cameras_on_an_arc()
    points = ball.points_on_the_ball(300, generator)
    observed = torch.rand(len(points), 6, generator=generator) < 0.4
    observed[:, 3] = True
    planes = tangent_planes(points, observed, cameras)
    each = torch.arange(len(points))
    assert observed[each, planes.reference].all()
    assert not planes.candidates[each, planes.reference].any()


def test_views_behind_the_plane_or_without_the_point_are_not_candidates(generator):
    cameras = ball.cameras_on_an_arc()
    along, up = torch.rand(2, 40, generator=generator, dtype=torch.float64) - 0.5
    tilt = torch.tensor(torch.pi / 3).double()  # tilt of the wall's normal towards x
    wall = torch.stack([along * tilt.cos(), up, along * tilt.sin()], dim=1)
    points = torch.cat([wall, torch.tensor([[90.0, 0, 0]]).double()])
    by_side = cameras.centers_world[:, 0].argsort()
    observed = torch.zeros(len(points), 6, dtype=torch.bool)
    observed[:, by_side[-1]] = True
    planes = tangent_planes(points, observed, cameras)
    assert not planes.candidates[:-1, by_side[:2]].any()
    assert planes.candidates[:-1, by_side[2:-1]].all()
    assert not planes.candidates[-1].any()


def test_homographies_map_steps_of_the_plane_to_pixels(generator):
    cameras = ball.cameras_on_an_arc()
    points = ball.points_on_the_ball(20, generator)
    planes = tangent_planes(points, torch.ones(20, 6, dtype=torch.bool), cameras)
    place = torch.tensor([3.0, -2.0, 1.0]).double()
    homogeneous = plane_homographies(planes, cameras, 2, torch.arange(20)) @ place
    expected, _ = project(
        points + 3 * planes.steps_world[:, 0] - 2 * planes.steps_world[:, 1],
        cameras.cam_from_world[2],
        cameras.intrinsics[2],
    )
    torch.testing.assert_close(homogeneous[:, :2] / homogeneous[:, 2:], expected)


def test_views_are_kept_evenly_or_all_if_few(generator):
    candidates = torch.rand(200, 90, generator=generator) < torch.rand(200, 1, generator=generator)
    kept = evenly(candidates, torch.full((200, 1), 24))
    assert not (kept & ~candidates).any()
    count = candidates.sum(dim=1)
    assert torch.equal(kept.sum(dim=1), count.clamp_max(24))
    assert torch.equal(kept[count <= 24], candidates[count <= 24])
    many = evenly(torch.ones(1, 96, dtype=torch.bool), torch.tensor([[24]]))
    assert not evenly(candidates, torch.zeros(200, 1, dtype=torch.long)).any()
    assert torch.nonzero(many[0])[:, 0].diff().unique().tolist() == [4]
