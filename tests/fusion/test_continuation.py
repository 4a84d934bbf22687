import pytest
import torch
from scenes import subdivided_square
from torch.testing import assert_close

from pimper_torch.geometry.topology import face_edges
from pimper_torch.linalg.continuation import about_mean, continued, enclosed


@pytest.fixture(scope="module")
def square():
    """Vertices and faces of a fine square."""
    subdivision = subdivided_square(0.05)
    return subdivision.points, subdivision.faces


def ramp(points):
    return torch.stack([points[:, 0], 2 - points[:, 1]], dim=1)


def test_continuation_is_pulled_to_prior_values_by_their_weight(square):
    points, faces = square
    known = points[:, 0] < 0.5
    far = points[:, 0] > 0.9
    near = ~known & (points[:, 0] < 0.55)
    ones, none = torch.ones(len(points), 1).double(), torch.zeros(len(points), 1).double()

    def drawn(by):
        return continued(
            ones, known, face_edges(faces)[0], none, torch.full((len(points),), by).double()
        )

    assert drawn(1e-5)[~known].min() > 0.98
    between = drawn(0.1)
    assert between[near].min() > 0.5
    assert between[far].max() < 0.5 * between[near].min()
    tight = drawn(1e2)
    assert tight[~known].max() < 0.1
    assert torch.equal(tight[known], ones[known])


def test_only_holes_among_known_vertices_are_enclosed(square):
    points, faces = square
    hole = (points[:, :2] - torch.tensor([0.3, 0.3])).norm(dim=1) < 0.15
    bay = (points[:, :2] - torch.tensor([1.0, 0.7])).norm(dim=1) < 0.2
    assert torch.equal(enclosed(~(hole | bay), faces), hole)
    joined = hole | bay | ((points[:, 1] - 0.5 - 0.3 * (points[:, 0] - 0.6)).abs() < 0.3)
    assert not enclosed(~joined, faces).any()
    # A surface without known vertices has no enclosed ones, even if it is closed.
    ball = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    assert not enclosed(torch.zeros(4, dtype=torch.bool), ball).any()
    assert enclosed(torch.tensor([True, False, False, False]), ball).sum() == 3


def test_noise_is_not_continued_far(square):
    points, faces = square
    generator = torch.Generator().manual_seed(3)
    known = points[:, 0] < 0.5
    noise = torch.randn(len(points), 1, generator=generator).double()
    steady = torch.where(known, 1 - points[:, 1], 0)[:, None]
    far = points[:, 0] > 0.95
    of_noise = about_mean(noise, known, face_edges(faces)[0])[far] - noise[known].mean()
    of_ramp = about_mean(steady, known, face_edges(faces)[0])[far] - steady[known].mean()
    assert of_noise.abs().max() < 0.01 * noise[known].std()
    assert of_ramp.abs().max() > 0.2 * steady[known].std()


def test_components_without_known_vertices_have_the_mean(square):
    points, faces = square
    apart = torch.cat([faces, faces + len(points)])
    values = torch.cat([ramp(points), torch.full_like(ramp(points), 100.0)])
    known = torch.arange(2 * len(points)) < len(points)
    found = about_mean(values, known, face_edges(apart)[0])
    mean = ramp(points).mean(dim=0).expand(len(points), 2)
    assert_close(found[len(points) :], mean, atol=1e-6, rtol=0)


@pytest.mark.parametrize("everywhere", [True, False])
def test_fully_known_or_unknown_values_are_unchanged(square, everywhere):
    points, faces = square
    known = torch.full((len(points),), everywhere)
    assert torch.equal(about_mean(ramp(points), known, face_edges(faces)[0]), ramp(points))


def test_gradients_reach_known_values_only(square):
    points, faces = square
    known = (points[:, :2] - 0.5).norm(dim=1) > 0.25
    values = ramp(points).requires_grad_()
    about_mean(values, known, face_edges(faces)[0])[~known].sum().backward()
    assert (values.grad[~known] == 0).all()
    # Each unknown value is a weighted mean of its surroundings: weights sum to one.
    assert_close(values.grad.sum(), torch.tensor(2.0 * int((~known).sum())).double())
