import pytest
import torch
from torch.testing import assert_close

from pimper_bench.metrics import sample_surface, thin
from pimper_torch.records import Mesh


def test_samples_are_even_by_area_not_by_face(generator, make):
    # One half of the square is one triangle, the other is divided into a hundred slivers.
    edge = torch.linspace(0, 1, 101, dtype=torch.float64)
    fan = torch.stack([edge, 1 + 0 * edge, 0 * edge], dim=1)  # along the upper edge
    corners = torch.cat([torch.tensor([[0.0, 0, 0], [1, 0, 0]]).double(), fan])
    slivers = torch.stack([torch.zeros(100).long(), torch.arange(3, 103), torch.arange(2, 102)], 1)
    faces = torch.cat([torch.tensor([[0, 1, 102]]), slivers])
    samples = sample_surface(Mesh(vertices_world=corners, faces=faces), 4000, generator)
    lower = samples.points[:, 1] < samples.points[:, 0]
    assert abs(float(lower.double().mean()) - 0.5) < 1e-3  # stratified: far below 1/sqrt(4000)
    mean = samples.points.mean(dim=0)
    assert_close(mean, torch.tensor([0.5, 0.5, 0.0]).double(), atol=0.02, rtol=0)
    # Second moment of the unit square about its centre; wrong folding would change it.
    moment = (samples.points[:, :2] - 0.5).square().mean(dim=0)
    assert_close(moment, torch.full((2,), 1 / 12).double(), atol=0.004, rtol=0)
    assert_close(samples.normals.abs()[:, 2], torch.ones(4000).double())


def test_a_cloud_is_sampled_by_its_points_once(generator):
    places = torch.randn(30, 3, generator=generator, dtype=torch.float64)
    cloud = Mesh(vertices_world=places, faces=torch.zeros(0, 3, dtype=torch.long))
    assert len(torch.unique(sample_surface(cloud, 20, generator).points, dim=0)) == 20
    assert len(sample_surface(cloud, 99, generator).points) == 30


def one_by_one(points, order, distance):
    kept = []
    for index in order.tolist():
        if all(float((points[index] - points[other]).norm()) > distance for other in kept):
            kept.append(index)
    return kept


@pytest.mark.parametrize("batch", [7, 1000])
def test_thinning_in_batches_equals_thinning_one_by_one(generator, monkeypatch, batch):
    from pimper_bench.metrics import dtu_protocol

    monkeypatch.setattr(dtu_protocol, "_BATCH", batch)
    points = torch.rand(300, 3, generator=generator, dtype=torch.float64)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(5))
    kept = thin(points, 0.2, torch.Generator().manual_seed(5))
    assert kept.tolist() == one_by_one(points, order, 0.2)
    assert 10 < len(kept) < 290  # a part is thinned, a part kept
