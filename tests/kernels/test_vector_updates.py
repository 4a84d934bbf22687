import pytest
import torch
from scipy.sparse.linalg import spsolve
from torch.testing import assert_close

from pimper_torch.ground.linalg.conjugate_gradients import compressed_gradients, conjugate_gradients
from pimper_torch.ground.linalg.hierarchy import Hierarchy
from tests.linalg.laplacians import triangles
from tests.threads import on_threads

CPU = torch.device("cpu")


def random(*shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(11), dtype=torch.float64)


@pytest.mark.parametrize(("sides", "dtype"), [(1, torch.float32), (4, torch.float64)])
def test_solutions_are_scipys(sides, dtype):
    matrix, rhs = triangles(60, 4.0), random(3600, sides)
    cycle = Hierarchy(matrix, CPU, dtype=dtype).cycle
    options = {"tolerance": 1e-12, "max_iterations": 100, "dtype": dtype}
    found, steps, converged = compressed_gradients(matrix, cycle, rhs, start=None, **options)
    assert converged
    assert 0 < steps < 60
    exact = torch.from_numpy(spsolve(matrix.tocsc(), rhs.numpy())).reshape(rhs.shape)
    assert_close(found, exact, rtol=1e-8, atol=1e-8 * float(exact.abs().max()))
    kept, none, _ = compressed_gradients(
        matrix, cycle, rhs, start=exact, **options | {"tolerance": 1e-8}
    )
    assert none == 0
    assert_close(kept, exact, rtol=0, atol=0)


def test_steps_are_those_of_torchs_vectors_and_of_any_number_of_threads():
    matrix, rhs = triangles(160, 3.0), random(25600, 2)
    hierarchy = Hierarchy(matrix, CPU)

    def times(vectors):
        return torch.from_numpy(matrix @ vectors.numpy())

    start = torch.from_numpy(matrix.diagonal()).rsqrt()[:, None] * random(25600, 2)
    options = {"start": start, "tolerance": 1e-30, "max_iterations": 5}
    expected, _, _ = conjugate_gradients(times, hierarchy.precondition, rhs, dims=(0,), **options)

    def found():
        return compressed_gradients(matrix, hierarchy.cycle, rhs, **options)[0]

    one, two = on_threads(found, 1, 2)
    assert_close(one, expected, rtol=1e-8, atol=1e-8 * float(expected.abs().max()))
    assert_close(two, one, rtol=0, atol=0)


@pytest.mark.parametrize("wrong", ["nan", "limit"])
def test_what_does_not_converge_is_said(wrong):
    matrix, rhs = triangles(30, 1.0), random(900, 2)
    if wrong == "nan":
        rhs = rhs * torch.nan
    _, steps, converged = compressed_gradients(
        matrix,
        lambda vectors: vectors.clone(),
        rhs,
        start=None,
        tolerance=1e-12,
        max_iterations=2 if wrong == "limit" else 200,
    )
    assert not converged
    assert steps < 200
