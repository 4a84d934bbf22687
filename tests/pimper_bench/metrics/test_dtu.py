import pytest
import torch
from torch.testing import assert_close

from pimper_bench.metrics import dtu_figures
from pimper_bench.metrics.dtu_protocol import observed, supersample
from pimper_bench.truth import DtuProtocol
from pimper_torch.records import Mesh


def cloud(points):
    places = torch.as_tensor(points, dtype=torch.float64).reshape(-1, 3)
    return Mesh(vertices_world=places, faces=torch.zeros(0, 3, dtype=torch.long))


def protocol_of(mask=None, plane=(0.0, 0.0, 1.0, 0.5), side=40):
    """Return a protocol with a mask of ones; voxels of 1 mm have centres at integers."""
    return DtuProtocol(
        obs_mask=torch.ones(side + 1, side + 1, side + 1) > 0 if mask is None else mask,
        bounding_box=torch.tensor([[0.0, 0, 0], [side, side, side]], dtype=torch.float64),
        resolution=1.0,
        plane=torch.tensor(plane, dtype=torch.float64),
    )


def grid(spacing=1.0, count=20, z=10.0):
    x, y = torch.meshgrid(*[spacing * torch.arange(count) + 5.0] * 2, indexing="ij")
    return torch.stack([x, y, torch.full_like(x, z)], dim=-1).reshape(-1, 3).double()


def test_a_raised_grid_is_off_by_its_height_in_both_directions(generator):
    found = dtu_figures(cloud(grid(z=10.3)), grid(), protocol_of(), generator)
    height = pytest.approx(0.3, abs=1e-6)  # 10.3 is float32 in the grid
    assert found.mean_accuracy == height
    assert found.median_accuracy == height
    assert found.mean_completeness == height
    assert found.overall == height
    assert found.points == found.evaluated == found.evaluated_true == 400


def test_points_outside_the_mask_count_only_for_completeness(generator):
    mask = torch.ones(41, 41, 41) > 0
    mask[:15] = False  # x below 14.5
    raised = grid(z=10.0)
    raised[raised[:, 0] < 14.5, 2] += 3.0  # would increase the accuracy error
    found = dtu_figures(cloud(raised), grid(), protocol_of(mask), generator)
    assert found.mean_accuracy == 0
    assert found.evaluated == 200
    # Half the scan is 3 mm from its point; the row next to the good half is 1 mm away.
    far = [min(3.0, float(rows)) for rows in range(1, 11)]
    assert found.mean_completeness == pytest.approx(sum(far) / 20, rel=1e-6)
    assert found.overall == pytest.approx(found.mean_completeness / 2)


def test_the_scan_below_the_table_is_ignored(generator):
    scan = torch.cat([grid(), grid(z=2.0)])
    found = dtu_figures(cloud(grid()), scan, protocol_of(plane=(0, 0, 1, -5.0)), generator)
    assert found.mean_completeness == 0
    assert found.evaluated_true == 400
    whole = dtu_figures(cloud(grid()), scan, protocol_of(), generator)
    assert whole.mean_completeness == pytest.approx(4.0)  # half is 8 mm off


def test_outliers_of_twenty_millimetres_are_excluded_and_counted(generator):
    stray = torch.tensor([[10.0, 10.0, 29.9], [12.0, 10.0, 30.0]], dtype=torch.float64)
    found = dtu_figures(cloud(torch.cat([grid(), stray])), grid(), protocol_of(), generator)
    assert found.mean_accuracy == pytest.approx(19.9 / 401)
    assert found.capped_fraction == pytest.approx(1 / 402)


def test_dense_points_are_thinned_before_they_are_counted(generator):
    # Ten points at one bad position weigh as much as one.
    dense = torch.tensor([[10.0, 10.0, 15.0]]).double() + 0.01 * torch.arange(10)[:, None]
    found = dtu_figures(cloud(torch.cat([grid(), dense])), grid(), protocol_of(), generator)
    assert found.points == 401
    assert found.mean_accuracy == pytest.approx(5 / 401, rel=0.03)


def test_a_point_is_in_the_voxel_whose_centre_is_nearest():
    mask = torch.zeros(4, 4, 4) > 0
    mask[1, 2, 3] = True
    protocol = protocol_of(mask, side=3)
    inside = torch.tensor([[0.5, 1.6, 3.49], [1.49, 2.4, 2.5]], dtype=torch.float64)
    outside = torch.tensor([[0.49, 2, 3], [1.5, 2, 3], [1, 2, 3.5], [1, 2, -9]]).double()
    assert observed(inside, protocol).all()
    assert not observed(outside, protocol).any()


def test_points_outside_the_cells_of_the_box_are_not_evaluated(generator):
    # A box of 40 mm has one cell of 60 mm; a mask may reach past it.
    scan = torch.cat([grid(), torch.tensor([[61.0, 10, 10]]).double()])
    found = dtu_figures(cloud(grid()), scan, protocol_of(), generator)
    assert found.evaluated_true == 401
    assert found.capped_fraction_true == pytest.approx(1 / 401)


def test_faces_are_sampled_as_in_the_published_code():
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    mesh = Mesh(vertices_world=corners, faces=torch.tensor([[0, 1, 2]]))
    found = supersample(mesh, 0.24)  # 4 steps along each edge
    # Half steps of 1/4: (i + 1/2) / 4 + (j + 1/2) / 4 < 1 holds for i + j <= 2.
    subdivision = [
        [(i + 0.5) / 4, (j + 0.5) / 4, 0] for i in range(5) for j in range(5) if i + j <= 2
    ]
    assert_close(found, torch.cat([corners, torch.tensor(subdivision).double()]))
    assert len(supersample(mesh, 5.0)) == 3


def test_a_mesh_and_its_dense_points_have_equal_figures(generator):
    corners = torch.tensor([[5.0, 5, 10.3], [24, 5, 10.3], [24, 24, 10.3], [5, 24, 10.3]])
    mesh = Mesh(vertices_world=corners.double(), faces=torch.tensor([[0, 1, 2], [0, 2, 3]]))
    found = dtu_figures(mesh, grid(), protocol_of(), generator)
    assert found.mean_completeness == pytest.approx(0.3, abs=0.06)  # points 0.2 apart
    assert found.mean_accuracy > 0.3  # between the scan's points
