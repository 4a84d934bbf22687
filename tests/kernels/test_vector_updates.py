import numpy as np
import pytest
import torch
from scipy.sparse import diags_array
from scipy.sparse.linalg import LinearOperator, cg, spsolve
from torch.testing import assert_close

from pimper_torch.linalg.conjugate_gradients import compressed_gradients
from pimper_torch.linalg.hierarchy import Hierarchy
from tests.linalg.laplacians import triangles
from tests.threads import on_threads


def random(*shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(11), dtype=torch.float64)


@pytest.mark.parametrize(("sides", "dtype"), [(1, torch.float32), (4, torch.float64)])
def test_solutions_agree_with_scipy(sides, dtype):
    matrix, rhs = triangles(60, 4.0), random(3600, sides)
    hierarchy = Hierarchy(matrix, dtype)
    options = {"tolerance": 1e-12, "max_iterations": 100}
    found, steps, converged = compressed_gradients(matrix, hierarchy, rhs, start=None, **options)
    assert converged
    assert 0 < steps < 60
    exact = torch.from_numpy(spsolve(matrix.tocsc(), rhs.numpy())).reshape(rhs.shape)
    assert_close(found, exact, rtol=1e-8, atol=1e-8 * float(exact.abs().max()))
    kept, none, _ = compressed_gradients(
        matrix, hierarchy, rhs, start=exact, **options | {"tolerance": 1e-8}
    )
    assert none == 0
    assert_close(kept, exact, rtol=0, atol=0)


def test_steps_agree_with_scipy_and_are_thread_invariant():
    matrix, rhs = triangles(160, 3.0), random(25600, 2)
    hierarchy = Hierarchy(matrix)

    def cycled(vector):
        return hierarchy.cycle(torch.from_numpy(vector)[:, None])[:, 0].clone().numpy()

    start = torch.from_numpy(matrix.diagonal()).rsqrt()[:, None] * random(25600, 2)
    options = {"start": start, "tolerance": 1e-30, "max_iterations": 5}
    inverse = LinearOperator(matrix.shape, cycled, dtype=np.float64)
    expected = torch.stack(
        [
            torch.from_numpy(cg(matrix, side, first, rtol=0, maxiter=5, M=inverse)[0])
            for side, first in zip(rhs.T.numpy(), start.T.numpy(), strict=True)
        ],
        dim=1,
    )

    def found():
        return compressed_gradients(matrix, hierarchy, rhs, **options)[0]

    one, two = on_threads(found, 1, 2)
    assert_close(one, expected, rtol=1e-8, atol=1e-8 * float(expected.abs().max()))
    assert_close(two, one, rtol=0, atol=0)


@pytest.mark.parametrize("wrong", ["nan", "limit"])
def test_non_convergence_is_reported(wrong):
    matrix, rhs = triangles(30, 1.0), random(900, 2)
    if wrong == "nan":
        rhs = rhs * torch.nan
    _, steps, converged = compressed_gradients(
        matrix,
        Hierarchy(diags_array(matrix.diagonal()).tocsr()),
        rhs,
        start=None,
        tolerance=1e-12,
        max_iterations=2 if wrong == "limit" else 200,
    )
    assert not converged
    assert steps < 200
