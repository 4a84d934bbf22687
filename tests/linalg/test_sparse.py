import subprocess
import sys

import pytest
import torch
from torch.testing import assert_close

from pimper_torch.linalg.prepared import SingularSystemError
from pimper_torch.linalg.sparse import SparseCholesky


def edges_of_a_path_with_shortcuts(size):
    first = torch.arange(size - 1)
    start = torch.cat([first, torch.arange(0, size - 5, 3)])
    end = torch.cat([first + 1, torch.arange(0, size - 5, 3) + 5])
    return start, end


def laplacian(weights, start, end, anchor):
    """Return entries of a Laplacian, four per edge, so that diagonal entries repeat."""
    loop = torch.arange(len(anchor))
    rows = torch.cat([start, end, start, end, loop])
    cols = torch.cat([start, end, end, start, loop])
    values = torch.cat([weights, weights, -weights, -weights, anchor])
    return rows, cols, values


def small_system(generator, size=12):
    start, end = edges_of_a_path_with_shortcuts(size)
    weights = 0.5 + torch.rand(len(start), generator=generator, dtype=torch.float64)
    anchor = 0.1 * torch.rand(size, generator=generator, dtype=torch.float64)
    return start, end, weights, anchor


def solve(rows, cols, values, rhs, what="the seams"):
    return SparseCholesky(rows, cols, values, len(rhs), what).solve(rhs)


@pytest.mark.parametrize("columns", [(), (3,), (0,)])
def test_solutions_equal_those_of_a_dense_solve(generator, columns):
    start, end, weights, anchor = small_system(generator)
    rows, cols, values = laplacian(weights, start, end, anchor)
    order = torch.randperm(len(rows), generator=generator)
    rhs = torch.randn(12, *columns, generator=generator, dtype=torch.float64)
    found = solve(rows[order], cols[order], values[order], rhs)
    dense = torch.zeros(12, 12).to(values).index_put((rows, cols), values, accumulate=True)
    expected = torch.linalg.solve(dense, rhs.reshape(12, -1))
    assert_close(found, expected.reshape(rhs.shape))


def test_gradients_reach_matrix_and_right_hand_side(generator):
    start, end, weights, anchor = small_system(generator, size=8)
    rhs = torch.randn(8, 2, generator=generator, dtype=torch.float64)
    inputs = [tensor.requires_grad_() for tensor in (weights, anchor, rhs)]

    def solution(weights, anchor, rhs):
        return solve(*laplacian(weights, start, end, anchor), rhs)

    assert torch.autograd.gradcheck(solution, inputs)
    assert torch.autograd.gradgradcheck(solution, inputs)


def test_float32_input_is_solved_in_float64_and_returned_as_float32():
    # 1 + 1e-6 and 1 differ by only 8 float32 steps: elimination in float32 loses the digits.
    delta = 2.0**-20
    values = torch.tensor([1.0, 1.0, 1.0, 1.0 + delta])
    rows, cols = torch.tensor([0, 0, 1, 1]), torch.tensor([0, 1, 0, 1])
    found = solve(rows, cols, values, torch.tensor([0.0, delta]))
    assert found.dtype == torch.float32
    assert_close(found, torch.tensor([-1.0, 1.0]), rtol=1e-6, atol=0)


def test_badly_scaled_unknowns_do_not_make_the_system_singular(generator):
    start, end, weights, anchor = small_system(generator)
    rows, cols, values = laplacian(weights, start, end, anchor)
    unit = 10 ** torch.linspace(-9, 9, 12, dtype=torch.float64)
    rhs = torch.randn(12, generator=generator, dtype=torch.float64)
    found = solve(rows, cols, values * unit[rows] * unit[cols], rhs * unit)
    assert_close(found * unit, solve(rows, cols, values, rhs))


def test_a_free_constant_is_rejected_even_if_the_right_hand_side_hides_it(generator):
    start, end, weights, anchor = small_system(generator)
    rows, cols, values = laplacian(weights, start, end, 0 * anchor)
    rhs = torch.zeros(12, dtype=torch.float64)
    rhs[0], rhs[1] = 1, -1
    with pytest.raises(SingularSystemError, match=r"the seams.*12 unknowns"):
        solve(rows, cols, values, rhs)


SQUARE = ([0, 0, 1, 1], [0, 1, 0, 1])


@pytest.mark.parametrize(
    ("rows", "cols", "values", "rhs", "message"),
    [
        (*SQUARE, [1.0, 2.0, 2.0, 1.0], [1.0, 1.0], "not positive definite"),
        ([0, 2], [0, 2], [1.0, 1.0], [1.0, 1.0, 1.0], "unknown 1"),
        ([0, 1, 1], [0, 0, 1], [2.0, 1.0, 3.0], [1.0, 1.0], "not symmetric"),
        ([0, 1], [0, 1], [1.0, torch.nan], [1.0, 1.0], "finite"),
        ([0, 1], [0, 1], [1.0, 1.0], [1.0, torch.nan], "finite"),
    ],
)
def test_systems_without_a_unique_solution_are_rejected(rows, cols, values, rhs, message):
    with pytest.raises(SingularSystemError, match=message):
        solve(*map(torch.tensor, (rows, cols, values, rhs)))


def test_exit_is_clean_with_a_live_differentiable_result():
    program = (
        "import torch; from pimper_torch.linalg.sparse import SparseCholesky; "
        "index = torch.arange(2); entries = torch.tensor([2.0, 4.0], requires_grad=True); "
        "found = SparseCholesky(index, index, entries, size=2).solve(torch.ones(2))"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")
