import numpy as np
import pytest

from pimper_torch.ground.kernels import sparse_products
from pimper_torch.ground.linalg.aggregation import parts_of
from tests.linalg.laplacians import triangles

FIRST, LAST = 5, 1590  # of 1600 rows: the others are left alone


@pytest.fixture(params=[np.float32, np.float64])
def system(request):
    matrix = triangles(40, 2.0).astype(request.param)
    rounding = 16 * np.finfo(request.param).eps * abs(matrix).max()
    return matrix, np.random.default_rng(3), rounding


def vectors(generator, sides, matrix):
    return generator.standard_normal((1600, sides)).astype(matrix.dtype)


def agree(found, expected, rounding):
    np.testing.assert_allclose(found[FIRST:LAST], expected[FIRST:LAST], rtol=0, atol=rounding)
    assert (found[:FIRST] == 7).all()
    assert (found[LAST:] == 7).all()


@pytest.mark.parametrize("sides", [1, 3])
def test_products_are_scipys(system, sides):
    matrix, generator, rounding = system
    given, start = (vectors(generator, sides, matrix) for _ in range(2))
    found = np.full_like(start, 7)
    sparse_products.product(*parts_of(matrix), given, start, found, 0.5, -2.0, FIRST, LAST)
    agree(found, 0.5 * start - 2 * (matrix @ given), rounding)


@pytest.mark.parametrize("sides", [1, 3])
def test_a_step_is_scaled_and_corrected_as_written_out(system, sides):
    matrix, generator, rounding = system
    residual, step, start = (vectors(generator, sides, matrix) for _ in range(3))
    inverse = generator.random(1600).astype(matrix.dtype)
    found = np.full_like(step, 7)
    sparse_products.scaled(inverse, residual, found, 0.4, FIRST, LAST)
    agree(found, 0.4 * inverse[:, None] * residual, rounding)
    found = np.full_like(step, 7)
    parts = parts_of(matrix)
    sparse_products.corrected(*parts, inverse, residual, step, start, found, 1.3, 0.6, FIRST, LAST)
    expected = start + 1.3 * step + 0.6 * inverse[:, None] * (residual - matrix @ step)
    agree(found, expected, rounding)
