import numpy as np
import pytest
import torch
from draws import normal
from scipy.sparse import csr_array
from torch.testing import assert_close

from pimper_torch.linalg import hierarchy
from pimper_torch.linalg.aggregation import prolongation
from pimper_torch.linalg.hierarchy import Hierarchy
from pimper_torch.linalg.multigrid import Multigrid
from pimper_torch.linalg.prepared import SingularSystemError
from pimper_torch.linalg.sparse import SparseCholesky
from pimper_torch.linalg.systems import prepare_system


def entries(size, generator, decades=6.0, anchor=1e-3):
    """Return a path graph with shortcuts and weights over many decades."""
    start = torch.cat([torch.arange(size - 1), torch.randint(size, (size,), generator=generator)])
    end = torch.cat([torch.arange(1, size), torch.randint(size, (size,), generator=generator)])
    apart = start != end
    start, end = start[apart], end[apart]
    weight = 10 ** (-decades * torch.rand(len(start), generator=generator, dtype=torch.float64))
    loop = torch.arange(size)
    held = anchor * torch.rand(size, generator=generator, dtype=torch.float64)
    rows = torch.cat([start, end, start, end, loop])
    cols = torch.cat([start, end, end, start, loop])
    return rows, cols, torch.cat([weight, weight, -weight, -weight, held])


def compressed(rows, cols, values, size):
    matrix = torch.zeros(size, size, dtype=torch.float64)
    return csr_array(matrix.index_put((rows, cols), values, accumulate=True).numpy())


@pytest.mark.parametrize("columns", [(), (0,), (2, 2)])
def test_solutions_equal_those_of_cholesky(columns, generator):
    parts = entries(1500, generator)
    rhs = normal(generator, 1500, *columns)
    found = Multigrid(*parts, size=1500).solve(rhs)
    expected = SparseCholesky(*parts, size=1500).solve(rhs)
    assert_close(found, expected, rtol=1e-6, atol=1e-6 * float(expected.abs().sum() > 0))


def test_the_cycle_is_symmetric_and_positive(generator):
    matrix = compressed(*entries(500, generator), 500)
    cycle = Hierarchy(matrix)
    assert len(cycle._levels) > 1
    inverse = cycle.cycle(torch.eye(500).double())
    assert (inverse - inverse.T).abs().max() <= 1e-9 * inverse.abs().max()
    assert torch.linalg.eigvalsh(inverse).min() > 0
    # For a good cycle, the spectrum of M A is within (0, 1 + small].
    spectrum = torch.linalg.eigvals(inverse @ torch.from_numpy(matrix.toarray())).real
    assert spectrum.max() < 1.5
    assert spectrum.min() > 0.02


def test_isolated_unknowns_have_no_coarse_unknown():
    matrix = csr_array(np.diag([1.0, 2.0, 3.0]))
    assert prolongation(matrix).shape == (3, 0)
    tied = np.array([[1.0, -1, 0, 0], [-1, 1, 0, 0], [0, 0, 5, -0.01], [0, 0, -0.01, 5]])
    spread = prolongation(csr_array(tied)).toarray()
    assert spread.shape == (4, 1)
    assert (spread[2:] == 0).all()


def test_weak_couplings_do_not_merge_strongly_coupled_pairs():
    """0-1 and 3-4 are strongly coupled; 2 is weakly coupled to 1 and 3."""
    matrix = np.zeros((5, 5))
    for one, other, weight in ((0, 1, 1.0), (1, 2, 1e-4), (2, 3, 2e-4), (3, 4, 1.0)):
        matrix[[one, other], [one, other]] += weight
        matrix[one, other] = matrix[other, one] = -weight
    spread = prolongation(csr_array(matrix)).toarray()
    assert spread.shape == (5, 2)
    assert (spread.argmax(axis=1) == spread.argmax(axis=1)[[0, 0, 3, 3, 3]]).all()
    assert spread.argmax(axis=1)[0] != spread.argmax(axis=1)[3]


def test_creases_in_the_near_null_space_cost_few_cycles(generator):
    side = 100
    pixel = torch.arange(side * side).reshape(side, side)
    one = torch.cat([pixel[:, :-1].flatten(), pixel[:-1].flatten()])
    other = torch.cat([pixel[:, 1:].flatten(), pixel[1:].flatten()])
    fraction = torch.ones(side, side, dtype=torch.float64)
    fraction[::10] = 0.3
    a, b = fraction.flatten()[one], fraction.flatten()[other]
    anchor = torch.full((side * side,), 1e-6)
    rows = torch.cat([one, other, one, other, pixel.flatten()])
    cols = torch.cat([one, other, other, one, pixel.flatten()])
    system = Multigrid(rows, cols, torch.cat([a * a, b * b, -a * b, -a * b, anchor]), side * side)
    # 90 if the prolongation keeps constants.
    assert system.iterate(normal(generator, side * side))[1] <= 40


def test_a_matrix_solved_by_smoothing_needs_no_levels(generator):
    size = 3000
    rows, cols, values = entries(size, generator, decades=1.0, anchor=0.0)
    loop = torch.arange(size)
    parts = (
        torch.cat([rows, loop]),
        torch.cat([cols, loop]),
        torch.cat([values, torch.full((size,), 1e4, dtype=torch.float64)]),
    )
    system = Multigrid(*parts, size=size)
    rhs = normal(generator, size)
    assert_close(system.solve(rhs), SparseCholesky(*parts, size=size).solve(rhs))
    assert system.iterate(rhs)[1] < 8


def test_gradients_reach_matrix_and_right_hand_side(generator, monkeypatch):
    monkeypatch.setattr(hierarchy, "_DENSE", 3)  # so that there are cycles to differentiate
    rows, cols, values = entries(7, generator, decades=1.0, anchor=0.3)
    assert len(Hierarchy(compressed(rows, cols, values, 7))._levels) > 1
    rhs = normal(generator, 7).requires_grad_()
    half = (len(values) - 7) // 4
    weight = values[:half].clone().requires_grad_()

    def solve(weight, rhs):
        filled = torch.cat([weight, weight, -weight, -weight, values[-7:]])
        return Multigrid(rows, cols, filled, size=7, tolerance=1e-14).solve(rhs)

    assert torch.autograd.gradcheck(solve, [weight, rhs])


def test_float32_input_gives_float32_output(generator):
    rows, cols, values = entries(1200, generator, decades=2.0, anchor=1.0)
    rhs = normal(generator, 1200).float()
    found = Multigrid(rows, cols, values.float(), size=1200).solve(rhs)
    expected = SparseCholesky(rows, cols, values.float(), size=1200).solve(rhs)
    assert found.dtype == torch.float32
    assert_close(found, expected, rtol=1e-5, atol=1e-5)


def test_an_indefinite_matrix_is_rejected_with_iterations_and_residual(generator):
    rows, cols, values = entries(900, generator, decades=1.0, anchor=0.0)
    loop = torch.arange(900)
    shifted = torch.cat([values, torch.full((900,), -0.05, dtype=torch.float64)])
    with pytest.raises(SingularSystemError, match=r"the seams.*after \d+ iterations"):
        Multigrid(
            torch.cat([rows, loop]), torch.cat([cols, loop]), shifted, 900, "the seams"
        ).solve(normal(generator, 900))


def test_a_smooth_solution_is_accepted_once_its_error_is_below_the_tolerance(generator):
    """Its right-hand side is small relative to its energy norm, as are negligible residuals."""
    tolerance = 1e-3
    parts = entries(1500, generator, decades=1.0, anchor=1e-6)
    rhs = torch.ones(1500, dtype=torch.float64)
    found = Multigrid(*parts, size=1500, tolerance=tolerance).solve(rhs)
    expected = SparseCholesky(*parts, size=1500).solve(rhs)
    matrix = torch.from_numpy(compressed(*parts, 1500).toarray())
    scale, off = matrix.diagonal().rsqrt(), found - expected
    assert (scale * (matrix @ off)).norm() > 10 * tolerance * (scale * rhs).norm()
    assert off @ matrix @ off <= tolerance**2 * (expected @ matrix @ expected)


def test_the_solver_is_chosen_by_the_matrix(generator, monkeypatch):
    monkeypatch.setattr("pimper_torch.linalg.systems._CHOLESKY_UNKNOWNS", 100)
    rows, cols, values = entries(200, generator)
    assert isinstance(prepare_system(rows, cols, values, 200), Multigrid)
    loop = torch.arange(200)  # positive couplings, made definite
    blocks = torch.cat([values.abs(), torch.full((200,), 50.0, dtype=torch.float64)])
    whole = torch.cat([rows, loop]), torch.cat([cols, loop]), blocks
    assert isinstance(prepare_system(*whole, 200), SparseCholesky)
    small = entries(50, generator)
    assert isinstance(prepare_system(*small, 50), SparseCholesky)
