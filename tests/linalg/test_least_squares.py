import torch
from draws import normal
from torch.testing import assert_close

from pimper_torch.linalg.least_squares import normal_equations


def test_normal_equations_are_those_of_the_dense_matrix(generator):
    unknowns = torch.randint(6, (9, 3), generator=generator)
    coefficients, targets = normal(generator, 9, 3), normal(generator, 9)
    weights = torch.rand(9, generator=generator, dtype=torch.float64)
    rows, cols, values, rhs = normal_equations(unknowns, coefficients, targets, weights, 6)
    dense = torch.zeros(9, 6, dtype=torch.float64)
    for equation in range(9):
        for unknown, coefficient in zip(unknowns[equation], coefficients[equation], strict=True):
            dense[equation, unknown] += coefficient
    matrix = torch.zeros(6, 6, dtype=torch.float64)
    matrix.index_put_((rows, cols), values, accumulate=True)
    assert_close(matrix, dense.T @ torch.diag(weights) @ dense)
    assert_close(rhs, dense.T @ (weights * targets))
