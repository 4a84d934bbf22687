import torch
from torch.testing import assert_close

from pimper_torch.single_view.factorization.bas_relief import BasRelief, convex, standard_relief


def rounded(shading, weight, mask):
    return convex(standard_relief(shading, weight), shading, weight, mask).on_shading(shading)


def test_any_relief_of_a_ball_is_made_a_ball_again(ball):
    weight = torch.ones(ball.columns.shape[1], dtype=torch.float64)
    number = torch.tensor([0.3, -0.7, 0.4, -0.25], dtype=torch.float64)
    for lam in number[2:]:
        shading = BasRelief(mu=number[0], nu=number[1], lam=lam).on_shading(ball.columns)
        found = rounded(shading, weight, ball.mask)
        # A disc cut short of the rim is flatter than a half ball: by 3 %, from 0.97 squared.
        assert_close(found[2], ball.columns[2])
        assert (found[:2] - ball.columns[:2]).abs().max() < 0.07


def test_the_choice_does_not_depend_on_the_relief_it_starts_from(bumpy, generator):
    weight = torch.rand(bumpy.columns.shape[1], generator=generator, dtype=torch.float64)
    mu, nu, lam = torch.tensor([0.2, 0.5, -3.0], dtype=torch.float64)
    moved = BasRelief(mu=mu, nu=nu, lam=lam).on_shading(bumpy.columns)
    assert_close(rounded(bumpy.columns, weight, bumpy.mask), rounded(moved, weight, bumpy.mask))


def test_the_convex_one_has_normals_that_point_outwards(ball):
    weight = torch.ones(ball.columns.shape[1], dtype=torch.float64)
    mu, nu, lam = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    for sign in (1.0, -1.0):
        relief = BasRelief(mu=sign * mu, nu=sign * nu, lam=sign * lam)
        assert convex(relief, ball.columns, weight, ball.mask).lam == 1
