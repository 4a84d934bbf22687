import numpy as np
import pytest
import torch
from scipy.sparse import diags_array
from torch.testing import assert_close

from pimper_torch.kernels import multigrid_levels as kernels
from pimper_torch.linalg.aggregation import (
    coarser,
    dominant_diagonal,
    parts_of,
    prolongation,
)
from pimper_torch.linalg.hierarchy import Hierarchy
from tests.linalg.laplacians import triangles


@pytest.mark.parametrize(
    ("side", "decades"),
    [(60, 10.0), (160, 0.0)],  # the larger one has more rows than one thread processes
)
def test_prolongation_keeps_constants_without_anchors(side, decades):
    matrix = triangles(side, decades)
    diagonal = np.maximum(matrix.diagonal(), abs(matrix).sum(axis=1) / 2)
    np.testing.assert_allclose(dominant_diagonal(matrix), diagonal, rtol=1e-12)
    free = (matrix - diags_array(matrix.sum(axis=1) - 1e-9)).tocsr()
    found = prolongation(free)
    assert 0 < found.shape[1] < 0.5 * found.shape[0]
    assert found.data.min() >= 0
    rows = found.sum(axis=1)
    np.testing.assert_allclose(rows[rows > 0], 1, rtol=1e-6)
    assert (rows > 0).mean() > 0.99  # others are isolated


@pytest.mark.parametrize(("side", "decades"), [(60, 10.0), (300, 0.0)])
def test_coarse_matrices_equal_scipy_products(side, decades):
    matrix = triangles(side, decades)
    spread = prolongation(matrix)
    gather = spread.T.tocsr()
    found, expected = coarser(matrix, spread, gather), gather @ (matrix @ spread)
    assert found.shape == expected.shape
    assert abs(found - expected).max() <= 1e-12 * abs(expected).max()
    count = found.nnz
    found.sum_duplicates()
    assert found.nnz == count  # no duplicate columns in a row


def test_rows_of_many_entries_are_allocated():
    """Every coarse unknown couples to every other: more than the initial allocation."""
    generator = np.random.default_rng(0)
    matrix = triangles(10, 1.0)
    spread = type(matrix)(generator.random((100, 40)))
    found = coarser(matrix, spread, spread.T.tocsr())
    expected = spread.toarray().T @ matrix.toarray() @ spread.toarray()
    np.testing.assert_allclose(found.toarray(), expected, rtol=1e-9, atol=1e-9)


def test_off_diagonal_entries_are_summed_by_sign():
    matrix = triangles(20, 2.0)
    matrix.data = matrix.data * np.random.default_rng(1).choice([-1.0, 1.0], len(matrix.data))
    off = matrix.toarray() * (1 - np.eye(400))
    for first, last in ((0, 400), (30, 31), (7, 7)):
        positive, size = kernels.off_diagonal(*parts_of(matrix), first, last)
        np.testing.assert_allclose(positive, off[first:last].clip(min=0).sum(), rtol=1e-12)
        np.testing.assert_allclose(size, abs(off[first:last]).sum(), rtol=1e-12)


@pytest.mark.parametrize("sides", [1, 3])
def test_a_float32_cycle_equals_a_float64_cycle_up_to_rounding(sides):
    matrix = triangles(160, 3.0)
    side = torch.randn(25600, sides, generator=torch.Generator().manual_seed(1)).double()
    expected = Hierarchy(matrix).cycle(side)
    found = Hierarchy(matrix, torch.float32).cycle(side.float())
    assert found.dtype == torch.float32
    assert_close(found.double(), expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))
