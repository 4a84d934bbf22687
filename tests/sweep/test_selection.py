import torch
from torch.testing import assert_close

from pimper_torch.stages.sweep.costs import best_views, poses_first, view_scores


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
