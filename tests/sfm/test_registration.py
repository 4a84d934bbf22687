"""Which pairs are matched again, and how often the mapper starts."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pimper_torch.sfm import registration
from pimper_torch.sfm.doubt import count_views_with_depth
from pimper_torch.sfm.mapping import MapSettings
from pimper_torch.sfm.matching import MatchSettings, VerifiedPair, all_pairs
from pimper_torch.sfm.model import select_views
from pimper_torch.sfm.registration import RegistrationSettings, register
from pimper_torch.sfm.static_background import StaticBackground
from pimper_torch.sfm.workspace import Workspace

MATCHING = MatchSettings(max_ratio=0.8, max_error_px=2.0, min_inliers=15, seed=0, threads=1)
MAPPING = MapSettings(min_inliers=6, pairs_count=False, seed=5)
SETTINGS = RegistrationSettings(matching=MATCHING, mapping=MAPPING, guided_pairs=1, starts=2)


class Told:
    """What matcher and mapper are told; what the mapper and the judge answer, run by run."""

    def __init__(self, models, misplaced=()):
        self.models, self.misplaced = list(models), list(misplaced)
        self.matched, self.mapped = [], []

    def match(self, space, pairs, settings):
        self.matched.append((False, list(pairs)))

    def guide(self, space, pairs, settings):
        self.matched.append((True, list(pairs)))

    def map(self, space, settings):
        self.mapped.append((settings.seed, settings.pairs_count))
        return [self.models.pop(0)]

    def judge(self, model, files, pairs, max_error_px):
        return self.misplaced.pop(0) if self.misplaced else {}


@pytest.fixture
def told(model, monkeypatch):
    """Five photographs whose neighbours share most matches."""

    def tell(numbers, misplaced=()):
        answers = Told([select_views(model, some) for some in numbers], misplaced)
        rest = StaticBackground(
            features=(), still_fraction=0.0, moving_pairs=0, violating_fraction=0.0
        )
        pairs = [
            VerifiedPair(
                views=pair,
                first=torch.zeros(9 - pair[1] + pair[0], 2).double(),
                second=torch.zeros(9 - pair[1] + pair[0], 2).double(),
            )
            for pair in all_pairs(5)
        ]
        monkeypatch.setattr(registration, "match_pairs", answers.match)
        monkeypatch.setattr(registration, "match_guided", answers.guide)
        monkeypatch.setattr(registration, "map_views", answers.map)
        monkeypatch.setattr(registration, "misplaced_views", answers.judge)
        monkeypatch.setattr(registration, "verified_pairs", lambda space: pairs)
        monkeypatch.setattr(registration, "leave_out_room", lambda database, settings: rest)
        monkeypatch.setattr(
            registration,
            "count_views_with_depth",
            lambda models, fewest: [one.num_views for one in models],
        )
        return answers

    return tell


@pytest.fixture
def space(model):
    return Workspace(folder=Path(), files=model.names, masked=False)


NEIGHBOURS = (True, [(0, 1), (1, 2), (2, 3), (3, 4)])
EVERY = range(5)


def test_a_complete_first_model_is_the_last(told, space):
    answers = told([EVERY])
    found = register(space, SETTINGS)
    assert found.complete
    assert answers.matched == [(False, all_pairs(5)), NEIGHBOURS]
    assert answers.mapped == [(5, False)]


def test_pairs_of_missing_photographs_are_guided_and_the_mapper_starts_again(told, space):
    answers = told([[0, 1, 2, 4], [0, 1, 2, 4], EVERY])
    found = register(space, SETTINGS)
    assert found.complete
    assert answers.matched[2:] == [(True, [(0, 3), (1, 3), (2, 3), (3, 4)])]
    assert answers.mapped == [(5, False), (5, False), (6, False)]


def test_every_pair_is_guided_where_a_view_is_misplaced(told, space):
    answers = told([EVERY, EVERY], [{"d.jpg": 0.1}])
    assert register(space, SETTINGS).complete
    assert answers.matched[2:] == [(True, all_pairs(5))]


def test_points_of_two_views_count_last_and_the_best_of_all_is_kept(told, space):
    some = [[0, 1, 2], [0, 1, 2, 4], EVERY, [0, 1, 2]]
    answers = told(some, [{}, {}, {"a.jpg": 0.1, "d.jpg": 0.2}, {}])
    found = register(space, SETTINGS)
    assert answers.mapped == [(5, False), (5, False), (6, False), (5, True)]
    # Four views, none misplaced, are better than five of which two are.
    assert found.missing == ("d.jpg",)
    assert not found.misplaced


def test_without_starts_the_first_model_is_kept_as_it_is(told, space):
    answers = told([[0, 1, 2]])
    settings = RegistrationSettings(matching=MATCHING, mapping=MAPPING, guided_pairs=0, starts=0)
    assert register(space, settings).missing == ("d.jpg", "ü.tif")
    assert answers.matched == [(False, all_pairs(5))]


def test_a_model_whose_views_all_see_too_few_points_is_none(told, space, monkeypatch):
    told(4 * [[0, 1]])
    monkeypatch.setattr(registration, "count_views_with_depth", count_views_with_depth)
    found = register(space, replace(SETTINGS, mapping=replace(MAPPING, min_inliers=1000)))
    assert found.models == ()
    assert found.missing == tuple(space.files)
