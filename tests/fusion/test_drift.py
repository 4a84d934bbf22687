import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.fusion.drift import drift
from pimper_torch.geometry.lattice import subdivide

FACETS = torch.tensor([[0, 1, 2], [0, 2, 3]])


@pytest.fixture
def lattice():
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.float64)
    return subdivide(corners, FACETS, torch.full((2,), 0.1, dtype=torch.float64))


def test_a_tilt_that_all_normals_share_is_found_and_detail_is_not(lattice):
    generator = torch.Generator().manual_seed(73)
    shape = torch.tensor([0.0, 0, 1]).double().expand(len(lattice.points), 3)
    detail = 0.05 * torch.randn(shape.shape, generator=generator, dtype=torch.float64)
    tilted = shape + torch.tensor([0.08, -0.03, 0]).double() + detail * torch.tensor([1, 1, 0])
    known = torch.ones(len(shape), dtype=torch.bool)
    found = drift(lattice, FACETS, tilted, shape, known)
    assert_close(
        found.tilt[:, :2], torch.tensor([[-0.08, 0.03]]).double().expand(2, 2), rtol=0, atol=0.02
    )
    corrected = tilted + found.at(lattice, FACETS)
    assert (corrected - shape - detail * torch.tensor([1, 1, 0])).norm(dim=1).max() < 0.03


def test_the_blend_is_continuous_and_only_normals_that_are_known_count(lattice):
    shape = torch.tensor([0.0, 0, 1]).double().expand(len(lattice.points), 3)
    normals = shape.clone()
    upper = lattice.facet == 1
    normals[upper] = normalize(torch.tensor([0.1, 0.0, 1.0]).double(), dim=0)
    normals[~upper] = torch.nan
    found = drift(lattice, FACETS, normals.nan_to_num(), shape, upper)
    assert found.known.tolist() == [False, True]
    assert_close(found.tilt[0], torch.zeros(3).double())
    at = found.at(lattice, FACETS)
    assert at.isfinite().all()
    # On the diagonal both facets have the same blend: that of its two corners.
    diagonal = (lattice.points[:, 0] - lattice.points[:, 1]).abs() < 1e-9
    assert_close(
        at[diagonal][:, 0], found.tilt[1, 0].expand(int(diagonal.sum())), rtol=1e-6, atol=0
    )


def test_a_cliff_does_not_turn_a_facet_by_more_than_a_quarter(lattice):
    shape = torch.tensor([0.0, 0, 1]).double().expand(len(lattice.points), 3)
    sideways = torch.tensor([1.0, 0, 0]).double().expand_as(shape)
    known = torch.ones(len(shape), dtype=torch.bool)
    assert drift(lattice, FACETS, sideways, shape, known).tilt.norm(dim=1).max() <= 0.25 + 1e-9
