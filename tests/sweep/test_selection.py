import torch
from torch.testing import assert_close

from pimper_torch.sweep.selection import best_views, view_scores


def test_the_best_usable_views_are_chosen_and_no_others():
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


def test_angle_resolution_and_light_all_count():
    ones = torch.ones(1, 3)
    fair = view_scores(ones, ones, ones)
    assert_close(fair, ones)
    worse = torch.tensor([[1.0, 1.0, 0.5]])
    for scores in (
        view_scores(worse, ones, ones),
        view_scores(ones, worse, ones),
        view_scores(ones, ones, worse),
    ):
        assert scores[0, 2] < scores[0, 0]
    finer = view_scores(ones, torch.tensor([[1.0, 1.0, 3.0]]), ones)
    assert_close(finer, fair)  # a sample that several pixels cover is no better judged
    assert float(view_scores(ones, ones, torch.tensor([[1.0, 1.0, -1.0]]))[0, 2]) == 0
