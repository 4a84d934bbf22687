import numpy as np
import pytest
import torch
from scipy.sparse import coo_array
from torch.testing import assert_close

from pimper_torch.kernels.switch import using
from pimper_torch.linalg.aggregation import dominant_diagonal, prolongation
from pimper_torch.linalg.hierarchy import Hierarchy

CPU = torch.device("cpu")


def triangles(side: int, decades: float, seed: int = 0):
    """A Laplacian of a triangle lattice whose weights vary over decades, with holes and anchors."""
    generator = np.random.default_rng(seed)
    name = np.arange(side * side).reshape(side, side)
    pairs = (name[:, :-1], name[:, 1:]), (name[:-1], name[1:]), (name[:-1, :-1], name[1:, 1:])
    one, other = np.concatenate([[a.ravel(), b.ravel()] for a, b in pairs], axis=1)
    weight = 10 ** (decades * generator.random(len(one)))
    weight[generator.random(len(one)) < 0.2] = 0
    anchor = 1e-4 + 10.0 * (generator.random(side * side) < 0.02)
    each = np.arange(side * side)
    rows = np.concatenate([one, other, one, other, each])
    cols = np.concatenate([other, one, one, other, each])
    values = np.concatenate([-weight, -weight, weight, weight, anchor])
    return coo_array((values, (rows.astype(np.int32), cols.astype(np.int32)))).tocsr()


@pytest.mark.parametrize("decades", [0.0, 4.0, 10.0])
def test_aggregates_are_those_of_numpy(decades):
    matrix = triangles(60, decades)
    found, diagonal = prolongation(matrix), dominant_diagonal(matrix)
    with using("torch"):
        expected, own = prolongation(matrix), dominant_diagonal(matrix)
    assert found.shape == expected.shape
    assert abs(found - expected).max() < 1e-12
    np.testing.assert_allclose(diagonal, own, rtol=1e-12)


@pytest.mark.parametrize("sides", [(), (1,), (2,), (3,)])
def test_a_cycle_is_that_of_torch_for_any_number_of_sides(sides):
    matrix = triangles(160, 3.0)  # more rows than one thread is given
    side = torch.randn(25600, *sides, generator=torch.Generator().manual_seed(1)).double()
    found = Hierarchy(matrix, CPU).precondition(side)
    with using("torch"):
        expected = Hierarchy(matrix, CPU).precondition(side)
    assert_close(found, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))
