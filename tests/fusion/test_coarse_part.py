import pytest
import torch
from scenes import FACETS, subdivided_square
from torch.testing import assert_close

from pimper_torch.stages.fusion.normal_bias import PiecewiseLinearFit


@pytest.fixture
def subdivision():
    return subdivided_square(0.02)


def test_functions_linear_on_facets_are_entirely_coarse(subdivision):
    corners = torch.tensor([0.3, -1.0, 2.0, 0.7], dtype=torch.float64)
    values = subdivision.interpolate(corners[:, None], FACETS)[:, 0]
    assert_close(PiecewiseLinearFit(subdivision, FACETS)(values), values, rtol=0, atol=1e-4)


def test_needles_and_waves_have_no_coarse_part(subdivision):
    needle = torch.zeros(len(subdivision.points), dtype=torch.float64)
    needle[len(needle) // 2] = 1.0
    assert PiecewiseLinearFit(subdivision, FACETS)(needle).abs().max() < 0.01
    waves = torch.sin(60 * subdivision.points[:, 0]) * torch.sin(60 * subdivision.points[:, 1])
    assert PiecewiseLinearFit(subdivision, FACETS)(waves).abs().max() < 0.05


def test_the_coarse_part_is_a_differentiable_projection(subdivision):
    generator = torch.Generator().manual_seed(79)
    values = torch.randn(len(subdivision.points), generator=generator, dtype=torch.float64)
    values.requires_grad_()
    found = PiecewiseLinearFit(subdivision, FACETS)(values)
    # The remainder is orthogonal to all functions that are linear on the facets.
    for corner in torch.eye(4, dtype=torch.float64):
        hat = subdivision.interpolate(corner[:, None], FACETS)[:, 0]
        assert abs(float(hat @ (values - found).detach())) < 1e-2
    found.sum().backward()
    assert_close(values.grad, torch.ones_like(values), rtol=0, atol=1e-2)
