import pytest
import torch

from tests.coarse.conftest import dome_cloud
from tests.published.scenes import ball, facets_over, grid, height_fields

__all__ = ["dome_cloud"]


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(7417)


@pytest.fixture
def sphere(generator):
    """Exact height fields on facets of a sphere of radius 2."""
    height, height_field = ball(2.0)
    return height_fields(facets_over(height, grid(generator)), height_field)


@pytest.fixture
def flat(generator):
    """Coplanar facets at z = 0."""
    return facets_over(lambda x, y: 0 * x, grid(generator))
