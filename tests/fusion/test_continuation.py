import pytest
import torch
from torch.testing import assert_close

from pimper_torch.fusion.continuation import continued
from pimper_torch.geometry.lattice import subdivide

WORLD = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]).double()


@pytest.fixture(scope="module")
def square():
    """Vertices and faces of a fine square."""
    facets = torch.tensor([[0, 1, 2], [0, 2, 3]])
    lattice = subdivide(WORLD, facets, torch.full((2,), 0.05).double())
    return lattice.points, lattice.faces


def ramp(points):
    return torch.stack([points[:, 0], 2 - points[:, 1]], dim=1)


def test_an_island_takes_what_lies_round_it_and_the_rest_is_kept(square):
    points, faces = square
    truth = ramp(points)
    island = (points[:, :2] - 0.5).norm(dim=1) < 0.25
    given = torch.where(island[:, None], 100.0, truth)
    found = continued(given, ~island, faces)
    assert torch.equal(found[~island], truth[~island])
    assert (found - truth)[island].abs().max() < 0.02
    # The mean would be off by a quarter at the island's edge.
    assert (truth[~island].mean(dim=0) - truth[island]).abs().max() > 0.2


def test_what_varies_much_from_step_to_step_is_not_carried_far(square):
    points, faces = square
    generator = torch.Generator().manual_seed(3)
    known = points[:, 0] < 0.5
    noise = torch.randn(len(points), 1, generator=generator).double()
    steady = torch.where(known, 1 - points[:, 1], 0)[:, None]
    far = points[:, 0] > 0.95
    of_noise = continued(noise, known, faces)[far] - noise[known].mean()
    of_ramp = continued(steady, known, faces)[far] - steady[known].mean()
    assert of_noise.abs().max() < 0.01 * noise[known].std()
    assert of_ramp.abs().max() > 0.2 * steady[known].std()


def test_parts_without_anything_known_take_the_mean(square):
    points, faces = square
    apart = torch.cat([faces, faces + len(points)])
    values = torch.cat([ramp(points), torch.full_like(ramp(points), 100.0)])
    known = torch.arange(2 * len(points)) < len(points)
    found = continued(values, known, apart)
    mean = ramp(points).mean(dim=0).expand(len(points), 2)
    assert_close(found[len(points) :], mean, atol=1e-6, rtol=0)


@pytest.mark.parametrize("everywhere", [True, False])
def test_with_everything_or_nothing_known_nothing_is_changed(square, everywhere):
    points, faces = square
    known = torch.full((len(points),), everywhere)
    assert torch.equal(continued(ramp(points), known, faces), ramp(points))


def test_values_that_are_all_alike_are_continued(square):
    points, faces = square
    known = points[:, 0] < 0.3
    alike = torch.where(known, 0.25, 7.0)[:, None].float()
    assert_close(continued(alike, known, faces), torch.full_like(alike, 0.25))


def test_gradients_are_those_of_what_is_known(square):
    points, faces = square
    known = (points[:, :2] - 0.5).norm(dim=1) > 0.25
    values = ramp(points).requires_grad_()
    continued(values, known, faces)[~known].sum().backward()
    assert (values.grad[~known] == 0).all()
    # Shares of those round it and of the mean: they add up to one for each unknown value.
    assert_close(values.grad.sum(), torch.tensor(2.0 * int((~known).sum())).double())
