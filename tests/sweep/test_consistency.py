import pytest
import torch
from torch.testing import assert_close

from pimper_torch.stages.sweep.costs import best_views, inconsistency, poses_first, view_scores

VIEWS = 8


@pytest.fixture
def shading(generator):
    return 0.3 + torch.rand(5, VIEWS, generator=generator, dtype=torch.float64)


def all_seen() -> torch.Tensor:
    return torch.ones(5, VIEWS, dtype=torch.bool)


def test_without_robustness_the_albedo_is_that_of_least_squares(generator, shading):
    radiance = torch.rand(5, VIEWS, 2, generator=generator, dtype=torch.float64)
    scale = torch.full((5,), 1e4, dtype=torch.float64)  # Cauchy's loss is the square
    cost = inconsistency(radiance, shading, all_seen(), scale) * 2e8  # 2 c^2
    albedo = torch.linspace(0, 3, 3001, dtype=torch.float64)
    apart = radiance[..., None] - albedo * shading[:, :, None, None]
    assert_close(cost, apart.square().sum(dim=1).amin(dim=-1), rtol=1e-4, atol=1e-4)


def test_one_shadowed_view_hardly_shifts_the_cost(shading):
    scale = torch.full((5,), 0.02, dtype=torch.float64)
    radiance = 0.5 * shading[..., None].repeat(1, 1, 1)
    radiance[:, 0] = 0
    robust = inconsistency(radiance, shading, all_seen(), scale, iterations=8)
    alone = inconsistency(radiance[:, :1], shading[:, :1], all_seen()[:, :1], scale)
    assert (robust > 1).all()  # the shadow itself has a cost
    assert (alone < 1e-9).all()  # a single view is always consistent
    right = 0.5 * torch.log1p((0.5 * shading[:, :1] / 0.02).square())
    assert_close(robust, right, rtol=0.01, atol=0)  # the others have almost none


def test_any_minority_of_disagreeing_views_is_outvoted(shading):
    scale = torch.full((5,), 0.01, dtype=torch.float64)
    radiance = 0.5 * shading[..., None]
    radiance[:, :3] *= 1.6
    right = 0.5 * torch.log1p((0.3 * shading[:, :3] / 0.01).square()).sum(dim=1, keepdim=True)
    cost = inconsistency(radiance, shading, all_seen(), scale)
    assert_close(cost, right, rtol=0.02, atol=0)


def test_the_cost_of_every_sample_is_scaled_by_its_noise(generator, shading):
    """Compare with the formula at the albedo that minimizes it on a grid, near the median."""
    albedo = 0.3 + torch.rand(5, 1, 1, generator=generator, dtype=torch.float64)
    scale = torch.tensor([0.01, 0.02, 0.05, 0.1, 0.2], dtype=torch.float64)
    noise = torch.randn(5, VIEWS, 2, generator=generator, dtype=torch.float64)
    radiance = albedo * shading[..., None] + 0.5 * scale[:, None, None] * noise
    cost = inconsistency(radiance, shading, all_seen(), scale, iterations=100)
    grid = torch.linspace(0, 2, 20_001, dtype=torch.float64)
    residual = radiance[..., None] - grid * shading[:, :, None, None]
    squares = (residual / scale[:, None, None, None]).square()
    assert_close(cost, 0.5 * torch.log1p(squares).sum(dim=1).amin(dim=-1), rtol=0, atol=1e-4)


def test_only_the_best_usable_views_are_chosen():
    generator = torch.Generator().manual_seed(63)
    score = torch.rand(50, 9, generator=generator)
    usable = torch.rand(50, 9, generator=generator) > 0.5
    chosen, meant = best_views(score, usable, 4)
    for row in range(50):
        mine = set(chosen[row][meant[row]].tolist())
        assert len(mine) == min(4, int(usable[row].sum()))
        assert all(usable[row, view] for view in mine)
        others = [view for view in range(9) if usable[row, view] and view not in mine]
        left = [float(score[row, view]) for view in others]
        assert all(float(score[row, view]) > max(left, default=-1.0) for view in mine)


def test_the_score_is_the_cosine_times_the_resolution_times_the_relative_light():
    facing = torch.tensor([[0.5, 1.0, 0.8, 1.0]])
    footprint = torch.tensor([[3.0, 0.5, 1.0, 2.0]])  # more than a pixel counts as one
    shading = torch.tensor([[2.0, 4.0, 1.0, -1.0]])  # the mean is 7/4, with -1 counted as 0
    expected = torch.tensor([[0.5 * 1.0, 0.5 * 1.0, 0.8 / 1.75, 0.0]])
    assert_close(view_scores(facing, footprint, shading), expected)
    assert (view_scores(facing, footprint, 0 * shading) == 0).all()  # no light


def test_the_best_view_of_each_pose_ranks_before_second_views():
    generator = torch.Generator().manual_seed(64)
    score = torch.rand(40, 9, generator=generator)
    usable = torch.rand(40, 9, generator=generator) > 0.3
    poses = torch.tensor([0, 1, 1, 2, 0, 1, 3, 3, 0])
    for row in range(40):
        shown = usable[row].nonzero()[:, 0].tolist()
        distinct = {int(poses[view]) for view in shown}
        chosen, meant = best_views(poses_first(score, usable, poses), usable, len(distinct))
        best = {
            pose: max((v for v in shown if poses[v] == pose), key=lambda v: float(score[row, v]))
            for pose in distinct
        }
        assert set(chosen[row][meant[row]].tolist()) == set(best.values())
    alone = torch.arange(9)
    assert torch.equal(poses_first(score, usable, alone), score)
