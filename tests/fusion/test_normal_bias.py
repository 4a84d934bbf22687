import pytest
import torch
from scenes import FACETS, subdivided_square
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.geometry.subdivision import subdivide
from pimper_torch.stages.fusion.equations import swept_heights
from pimper_torch.stages.fusion.normal_bias import (
    PiecewiseLinearFit,
    common_variance,
    normal_bias,
    shared_error,
)

UP = torch.tensor([0.0, 0, 1]).double()


@pytest.fixture
def subdivision():
    return subdivided_square(0.1)


def test_a_shared_tilt_is_removed_and_detail_kept(subdivision):
    generator = torch.Generator().manual_seed(73)
    shape = UP.expand(len(subdivision.points), 3)
    detail = 0.05 * torch.randn(shape.shape, generator=generator, dtype=torch.float64)
    tilted = shape + torch.tensor([0.08, -0.03, 0]).double() + detail * torch.tensor([1, 1, 0])
    known = torch.ones(len(shape), dtype=torch.bool)
    found = normal_bias(subdivision, FACETS, tilted, shape, known)
    assert_close(
        found.tilt[:, :2], torch.tensor([[-0.08, 0.03]]).double().expand(2, 2), rtol=0, atol=0.02
    )
    corrected = tilted + found.at(subdivision, FACETS)
    assert (corrected - shape - detail * torch.tensor([1, 1, 0])).norm(dim=1).max() < 0.03


def test_the_blend_is_continuous_and_ignores_unknown_normals(subdivision):
    shape = UP.expand(len(subdivision.points), 3)
    normals = shape.clone()
    upper = subdivision.facet == 1
    normals[upper] = normalize(torch.tensor([0.1, 0.0, 1.0]).double(), dim=0)
    normals[~upper] = torch.nan
    found = normal_bias(subdivision, FACETS, normals.nan_to_num(), shape, upper)
    assert found.known.tolist() == [False, True]
    assert_close(found.tilt[0], torch.zeros(3).double())
    at = found.at(subdivision, FACETS)
    assert at.isfinite().all()
    # On the diagonal, both facets have the blend of its two corners.
    diagonal = (subdivision.points[:, 0] - subdivision.points[:, 1]).abs() < 1e-9
    assert_close(
        at[diagonal][:, 0], found.tilt[1, 0].expand(int(diagonal.sum())), rtol=1e-6, atol=0
    )


def test_the_tilt_of_a_facet_is_bounded(subdivision):
    shape = UP.expand(len(subdivision.points), 3)
    sideways = torch.tensor([1.0, 0, 0]).double().expand_as(shape)
    known = torch.ones(len(shape), dtype=torch.bool)
    tilt = normal_bias(subdivision, FACETS, sideways, shape, known).tilt
    assert tilt.norm(dim=1).max() <= 0.25 + 1e-9


def test_the_variance_of_tilts_is_recovered():
    corners = torch.rand(602, 3, generator=torch.Generator().manual_seed(76)).double()
    facets = torch.stack([torch.arange(600), torch.arange(1, 601), torch.arange(2, 602)], dim=1)
    subdivision = subdivide(corners, facets, torch.full((600,), 0.3, dtype=torch.float64))
    generator = torch.Generator().manual_seed(77)
    shape = UP.expand(len(subdivision.points), 3)
    tilts = 0.02 * torch.randn(600, 2, generator=generator).double()
    normals = torch.cat([tilts, torch.ones(600, 1).double()], dim=1)[subdivision.facet]
    known = torch.ones(len(shape), dtype=torch.bool)
    variance = normal_bias(subdivision, facets, normals, shape, known).variance()
    found = shared_error(variance, subdivision.facet, known)
    assert float(found.variance) == pytest.approx(0.02**2, rel=0.15)
    assert_close(found.count, torch.bincount(subdivision.facet).double()[subdivision.facet])


def test_the_shared_error_of_heights_is_estimated_at_positions():
    facet = torch.arange(800).repeat_interleave(50)
    generator = torch.Generator().manual_seed(78)
    nothing = torch.zeros(len(facet), dtype=torch.float64)
    shared = 0.3 * torch.randn(800, generator=generator).double()
    own = torch.randn(len(facet), generator=generator).double()
    shared[400:] += 10  # without other evidence, the surface itself may be wrong
    shared[:10] = 5.0
    information = torch.ones_like(nothing)
    information[facet == 399] = 0
    found = swept_heights(
        nothing, shared[facet] + 0.1 * own, information, *torch.ones(2, len(nothing))
    )
    variance = common_variance(found, nothing, facet, torch.arange(400).repeat(2))
    shared = shared_error(variance, facet, information > 0)
    assert float(shared.variance) == pytest.approx(0.3**2, rel=0.15)
    assert shared.count[facet != 399].unique().tolist() == [50]
    assert shared.count[facet == 399].unique().tolist() == [0]


def test_without_other_positions_heights_have_no_shared_error():
    facet = torch.zeros(4, dtype=torch.long)
    ones = torch.ones(4, dtype=torch.float64)
    found = swept_heights(0 * ones, ones, ones, ones, ones)
    nowhere = common_variance(found, 0 * ones, facet, torch.zeros(0, dtype=torch.long))
    assert float(nowhere) == 0


@pytest.fixture
def finer():
    return subdivided_square(0.02)


def test_functions_linear_on_facets_are_entirely_coarse(finer):
    corners = torch.tensor([0.3, -1.0, 2.0, 0.7], dtype=torch.float64)
    values = finer.interpolate(corners[:, None], FACETS)[:, 0]
    assert_close(PiecewiseLinearFit(finer, FACETS)(values), values, rtol=0, atol=1e-4)


def test_needles_and_waves_have_no_coarse_part(finer):
    needle = torch.zeros(len(finer.points), dtype=torch.float64)
    needle[len(needle) // 2] = 1.0
    assert PiecewiseLinearFit(finer, FACETS)(needle).abs().max() < 0.01
    waves = torch.sin(60 * finer.points[:, 0]) * torch.sin(60 * finer.points[:, 1])
    assert PiecewiseLinearFit(finer, FACETS)(waves).abs().max() < 0.05


def test_the_coarse_part_is_a_differentiable_projection(finer):
    generator = torch.Generator().manual_seed(79)
    values = torch.randn(len(finer.points), generator=generator, dtype=torch.float64)
    values.requires_grad_()
    found = PiecewiseLinearFit(finer, FACETS)(values)
    # The remainder is orthogonal to all functions that are linear on the facets.
    for corner in torch.eye(4, dtype=torch.float64):
        hat = finer.interpolate(corner[:, None], FACETS)[:, 0]
        assert abs(float(hat @ (values - found).detach())) < 1e-2
    found.sum().backward()
    assert_close(values.grad, torch.ones_like(values), rtol=0, atol=1e-2)
