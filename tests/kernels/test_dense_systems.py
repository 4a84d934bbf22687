import torch
from torch.testing import assert_close

from pimper_torch.kernels.dense_systems import eliminate, solve_damped


def test_damped_systems_are_solved_as_by_lapack():
    generator = torch.Generator().manual_seed(3)
    for size in (4, 24, 96):
        root = torch.randn(size, size, generator=generator, dtype=torch.float64)
        matrix, side = root @ root.T, torch.randn(size, generator=generator, dtype=torch.float64)
        expected = torch.linalg.solve(matrix + 0.5 * torch.eye(size), side)
        upper, found = matrix.triu(), side.clone()  # the part below the diagonal is not read
        space = torch.empty_like(matrix)
        assert solve_damped(upper.numpy(), 0.5, found.numpy(), space.numpy())
        assert_close(found, expected)


def test_matrices_that_are_not_positive_are_detected():
    matrix, side = (
        torch.diag(torch.tensor([1.0, 1, 1, 1, 1, -1, 1, 1]).double()),
        torch.ones(8).double(),
    )
    space = torch.empty_like(matrix)
    assert not solve_damped(matrix.numpy(), 0.5, side.clone().numpy(), space.numpy())
    assert solve_damped(matrix.numpy(), 1.5, side.clone().numpy(), space.numpy())
    matrix[2, 2] = torch.nan
    assert not solve_damped(matrix.numpy(), 1.5, side.clone().numpy(), space.numpy())


def test_elimination_pivots_and_finds_singular_matrices():
    generator = torch.Generator().manual_seed(3)
    matrix = torch.randn(12, 12, generator=generator, dtype=torch.float64)
    matrix[0, 0] = 0
    sides = torch.randn(12, 2, generator=generator, dtype=torch.float64)
    found, space = sides.clone(), matrix.clone()
    assert eliminate(space.numpy(), found.numpy())
    assert_close(matrix @ found, sides)
    matrix[7] = 0
    assert not eliminate(matrix.numpy(), sides.numpy())
