import torch
from torch.testing import assert_close

from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.geometry.supporting_plane import fixation, supporting_plane


def cameras():
    view = {"width": 80, "height": 60, "focal_px": 90.0, "distance": 3.0, "span_deg": 120.0}
    return arc_cameras(9, **view, elevation_deg=40.0, target=(0.1, 0.4, -0.2))


def test_the_supporting_plane_of_a_table_is_found(generator):
    table = torch.rand(200, 3, generator=generator).double() * 4 - 2
    table[:, 1] = 0.002 * torch.randn(200, generator=generator)
    above = torch.randn(300, 3, generator=generator).double() * 0.2 + torch.tensor([0, 0.8, 0])
    plane = supporting_plane(torch.cat([above, table]), cameras().centers_world, 3.0)
    assert plane is not None
    assert_close(plane.normal_world, torch.tensor([0.0, 1, 0]).double(), atol=2e-3, rtol=0)
    height = plane.height_of(torch.tensor([1.0, 0.7, 1.0]).double())
    assert_close(height, torch.tensor(0.7).double(), atol=3e-3, rtol=0)


def test_points_without_a_plane_have_none(generator):
    points = torch.randn(500, 3, generator=generator).double()
    assert supporting_plane(points, cameras().centers_world, 3.0) is None


def test_a_plane_with_points_below_it_is_not_supporting(generator):
    table = torch.rand(300, 3, generator=generator).double() * 2 - 1
    table[:, 1] = 0.0
    points = torch.cat([table, table - torch.tensor([0, 0.5, 0])])
    found = supporting_plane(points, cameras().centers_world, 3.0)
    assert found is not None
    assert_close(found.offset, torch.tensor(-0.5).double(), atol=1e-6, rtol=0)  # the lower one


def test_a_plane_with_few_of_the_points_is_not_supporting(generator):
    points = torch.randn(500, 3, generator=generator).double()
    points[:, 1] = points[:, 1].abs() + 0.1
    for count, is_found in ((30, False), (60, True)):  # 6 and 11 % of all points
        table = torch.rand(count, 3, generator=generator).double() * 2 - 1
        table[:, 1] = 0.0
        found = supporting_plane(torch.cat([table, points]), cameras().centers_world, 3.0)
        assert (found is not None) is is_found


def test_points_count_by_the_space_in_which_they_are(generator):
    """A dense plate, its flat base above a table that has a tenth of the points."""
    base = 0.4 * torch.rand(3000, 3, generator=generator).double() - 0.2
    base[:, 1] = 0.1
    rim = torch.nn.functional.normalize(base - torch.tensor([0, 0.1, 0]), dim=1) * 0.5
    rim[:, 1] = 0.3
    table = 4 * torch.rand(300, 3, generator=generator).double() - 2
    table[:, 1] = 0.0
    table = table[table.norm(dim=1) > 0.6]
    found = supporting_plane(torch.cat([base, rim, table]), cameras().centers_world, 3.0)
    assert found is not None
    assert_close(found.offset, torch.tensor(0.0).double(), atol=1e-6, rtol=0)
    assert_close(found.normal_world, torch.tensor([0.0, 1, 0]).double(), atol=1e-6, rtol=0)


def test_look_at_aims_cameras_at_the_target():
    found = fixation(cameras().cam_from_world)
    assert_close(found.fixation_world, torch.tensor([0.1, 0.4, -0.2]).double(), atol=0.01, rtol=0)
    assert_close(found.distance, torch.tensor(3.0).double(), atol=0.01, rtol=0)
