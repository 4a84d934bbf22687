import pytest
import torch
from torch.testing import assert_close

from pimper_torch.errors import InputError
from pimper_torch.linalg.equations import bilinear_terms, normal_equations, raster_equations
from pimper_torch.linalg.poisson import differences
from pimper_torch.linalg.sparse import solve_spd


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(6343)


def random(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def test_normal_equations_are_those_of_the_dense_matrix(generator):
    unknowns = torch.randint(6, (9, 3), generator=generator)
    coefficients, targets = random(generator, 9, 3), random(generator, 9)
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


def test_the_equations_of_a_raster_hold_for_its_steps(generator):
    heights = random(generator, 4, 5)
    unknowns, coefficients, targets = raster_equations(*differences(heights))
    assert_close((coefficients * heights.flatten()[unknowns]).sum(dim=1), targets)
    assert len(targets) == 4 * 4 + 3 * 5


def test_bilinear_terms_give_what_is_bilinear_exactly_up_to_the_last_centre(generator):
    v, u = torch.meshgrid(torch.arange(4) + 0.5, torch.arange(6) + 0.5, indexing="ij")

    def height(u, v):
        return 1 + 2 * u - v + 0.5 * u * v

    places = torch.tensor([[0.5, 0.5], [5.5, 3.5], [5.5, 0.5], [2.0, 1.25], [3.5, 3.5]])
    pixels, shares = bilinear_terms(places, 4, 6)
    found = (shares * height(u, v).flatten()[pixels]).sum(dim=1)
    assert_close(found, height(*places.unbind(dim=1)))


def test_places_between_no_pixels_are_refused():
    with pytest.raises(InputError, match=r"1 of 2 samples.*6 x 4 pixels.*number 1"):
        bilinear_terms(torch.tensor([[1.0, 1.0], [5.6, 1.0]]), 4, 6)


def test_two_rasters_are_joined_by_their_overlap_into_one_surface(generator):
    """The second, half a pixel off, knows its steps only; the overlap tells its constant."""

    def height(u, v):
        return 0.3 * u - 0.2 * v + 0.1 * u * v

    v, u = torch.meshgrid(
        torch.arange(5).double() + 0.5, torch.arange(6).double() + 0.5, indexing="ij"
    )
    first, second = height(u, v), height(u + 3.5, v)
    sets = []
    for start, raster in ((0, first), (30, second)):
        unknowns, coefficients, targets = raster_equations(*differences(raster))
        weights = torch.ones_like(targets)
        sets.append(normal_equations(unknowns + start, coefficients, targets, weights, 60))
    places = torch.stack([u[:, :2] + 3.5, v[:, :2]], dim=-1).reshape(-1, 2)
    here, shares = bilinear_terms(places, 5, 6)
    there, theirs = bilinear_terms(places - places.new_tensor([3.5, 0]), 5, 6)
    sets.append(
        normal_equations(
            torch.cat([here, there + 30], dim=1),
            torch.cat([shares, -theirs], dim=1),
            places.new_zeros(len(places)),
            places.new_ones(len(places)),
            60,
        )
    )
    index, one = torch.tensor([[0]]), torch.ones(1, 1, dtype=torch.float64)
    sets.append(normal_equations(index, one, first[:1, 0], one[0], 60))
    rows, cols, values = (torch.cat([part[k] for part in sets]) for k in range(3))
    found = solve_spd(rows, cols, values, sum(part[3] for part in sets))
    assert_close(found, torch.cat([first.flatten(), second.flatten()]))
