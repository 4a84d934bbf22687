import pytest
import scipy.fft
import torch
from torch.testing import assert_close

from pimper_torch.paper.integrate import (
    cosine_basis,
    differences,
    differences_transposed,
    integrate_steps,
    solve_poisson,
)


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(5209)


def random(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def dense_solution(right, down, weight_right, weight_down):
    """Least squares with every step written out as a row."""
    height, width = down.shape[0] + 1, right.shape[1] + 1
    unit = torch.eye(height * width, dtype=torch.float64).reshape(-1, height, width)
    steps = torch.cat([part.flatten(1) for part in differences(unit)], dim=1).T
    weight = torch.cat([weight_right.flatten(), weight_down.flatten()]).sqrt()
    wanted = torch.cat([right.flatten(), down.flatten()])
    found = torch.linalg.lstsq(
        weight[:, None] * steps, (weight * wanted)[:, None], driver="gelsd"
    ).solution
    return found.reshape(height, width) - found.mean()


def test_the_cosine_basis_is_the_orthonormal_cosine_transform(generator):
    signal = random(generator, 7)
    expected = scipy.fft.dct(signal.numpy(), type=2, norm="ortho")
    assert_close(cosine_basis(7, signal) @ signal, torch.from_numpy(expected))


def test_the_transpose_of_differences_is_their_adjoint(generator):
    heights, right, down = (
        random(generator, 4, 5),
        random(generator, 4, 4),
        random(generator, 3, 5),
    )
    forward = differences(heights)
    assert_close(
        (forward[0] * right).sum() + (forward[1] * down).sum(),
        (heights * differences_transposed(right, down)).sum(),
    )


def test_the_solution_satisfies_poissons_equation(generator):
    source = random(generator, 3, 6, 9)
    found = solve_poisson(source)
    applied = differences_transposed(*differences(found))
    assert_close(applied, source - source.mean(dim=(1, 2), keepdim=True))
    assert_close(found.mean(dim=(1, 2)), torch.zeros(3, dtype=torch.float64))


def test_contradicting_steps_are_met_in_the_least_squares_sense(generator):
    right, down = random(generator, 1, 5, 5), random(generator, 1, 4, 6)
    expected = dense_solution(right[0], down[0], torch.ones(5, 5), torch.ones(4, 6))
    assert_close(integrate_steps(right, down)[0], expected)
