import pytest
import torch
from torch.testing import assert_close

from pimper_torch.single_view.factorization.bas_relief import BasRelief, standard_relief


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(3)


def some(generator, sign=1.0):
    mu, nu, size = torch.randn(3, generator=generator, dtype=torch.float64)
    return BasRelief(mu=mu, nu=nu, lam=sign * size.exp())


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_all_reliefs_of_a_surface_have_one_standard_form(generator, sign):
    b = torch.randn(3, 80, generator=generator, dtype=torch.float64)
    moved = some(generator, sign).on_shading(b)
    form = standard_relief(b).on_shading(b)
    other = standard_relief(moved).on_shading(moved)
    flip = torch.tensor([[sign], [sign], [1.0]], dtype=torch.float64)  # lambda below zero mirrors
    assert_close(other, flip * form)
    x, y, z = form
    assert_close(torch.stack([(x * z).sum(), (y * z).sum()]), torch.zeros(2).double())
    assert_close((x * x + y * y).sum(), (z * z).sum())


def test_a_plane_has_no_standard_form():
    b = torch.tensor([[0.0], [0.0], [-1.0]]) * torch.arange(1, 5)
    assert standard_relief(b).lam.isnan()
