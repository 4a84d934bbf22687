"""Which pairs are matched again, and how often the mapper starts."""

from dataclasses import replace

import pytest
import torch

from pimper_torch.method.sfm import registration
from pimper_torch.method.sfm.diagnose import MatchConsistency, count_views_with_depth
from pimper_torch.method.sfm.features import Workspace
from pimper_torch.method.sfm.matching import VerifiedPair, all_pairs
from pimper_torch.method.sfm.model import select_views
from pimper_torch.method.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.method.sfm.registration import register
from pimper_torch.method.sfm.static_background import StaticBackground
from pimper_torch.runtime.errors import PimperWarning

SETTINGS = ReconstructConfig(guided_pairs=1, starts=2, seed=5, threads=1)

RIGID = StaticBackground(features=(), static_fraction=0.0, moving_pairs=0, violating_fraction=0.0)
ROOM = RIGID.replace(features=5 * (torch.tensor([True, False]),), violating_fraction=0.5)

NOTHING = torch.zeros(3, 2).double()
MOVED = (VerifiedPair(views=(0, 1), first=NOTHING, second=NOTHING),)


class Told:
    """What matcher and mapper are told; what the mapper and the judge answer, run by run."""

    def __init__(self, models, misplaced=(), inlier_ratio=()):
        self.models, self.misplaced = list(models), list(misplaced)
        self.inlier_ratio, self.asked = list(inlier_ratio), []
        self.matched, self.mapped, self.databases = [], [], []

    def match(self, space, pairs, settings):
        self.matched.append((False, list(pairs)))

    def guide(self, space, pairs, settings):
        self.matched.append((True, list(pairs)))

    def map(self, space, seed, *, pairs_count):
        self.mapped.append((seed, pairs_count))
        self.databases.append(space.database_name)
        return [self.models.pop(0)]

    def judge(self, model, files, pairs, max_error_px):
        return MatchConsistency(
            inlier_ratio=self.inlier_ratio.pop(0) if self.inlier_ratio else 1.0,
            misplaced=self.misplaced.pop(0) if self.misplaced else {},
        )


@pytest.fixture
def told(model, monkeypatch):
    """Five photographs whose neighbours share most matches."""

    def note(numbers, misplaced=(), inlier_ratio=(), rest=RIGID, around=()):
        answers = Told([select_views(model, some) for some in numbers], misplaced, inlier_ratio)

        def leave_out(database, settings):
            answers.asked.append(database.name)
            return rest

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
        monkeypatch.setattr(registration, "MIN_POINTS", 6)
        monkeypatch.setattr(registration, "verify_model", answers.judge)
        monkeypatch.setattr(registration, "diagnose", lambda model, count: "")
        monkeypatch.setattr(registration, "verified_pairs", lambda space: pairs)
        monkeypatch.setattr(registration, "remove_static_features", leave_out)
        monkeypatch.setattr(registration, "pairs_to_match", lambda space: all_pairs(5))
        monkeypatch.setattr(registration, "link_sessions", lambda *_: around)
        monkeypatch.setattr(
            registration,
            "count_views_with_depth",
            lambda models, fewest: [one.num_views for one in models],
        )
        return answers

    return note


@pytest.fixture
def space(model, tmp_path):
    (tmp_path / "database.db").write_bytes(b"features and matches")
    return Workspace(folder=tmp_path, files=model.names, masked=False)


NEIGHBOURS = (True, [(0, 1), (1, 2), (2, 3), (3, 4)])
EVERY = range(5)


@pytest.mark.parametrize(
    ("models", "misplaced", "guided", "seeds"),
    [
        ([EVERY], [], [], [5]),  # a complete first model is the last
        # Pairs of missing photographs, and the mapper starts again.
        ([[0, 1, 2, 4]] * 2 + [EVERY], [], [[(0, 3), (1, 3), (2, 3), (3, 4)]], [5, 5, 6]),
        ([EVERY, EVERY], [{"d.jpg": 0.1}], [all_pairs(5)], [5, 5]),  # every pair
    ],
)
def test_the_mapper_starts_until_all_are_there(told, space, models, misplaced, guided, seeds):
    answers = told(models, misplaced)
    assert register(space, SETTINGS).complete
    assert answers.matched == [
        (False, all_pairs(5)),
        NEIGHBOURS,
        *((True, pairs) for pairs in guided),
    ]
    assert answers.mapped == [(seed, False) for seed in seeds]


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
    settings = replace(SETTINGS, guided_pairs=0, starts=0)
    assert register(space, settings).missing == ("d.jpg", "ü.tif")
    assert answers.matched == [(False, all_pairs(5))]


def test_a_model_whose_views_all_see_too_few_points_is_none(told, space, monkeypatch):
    told(4 * [[0, 1]])
    monkeypatch.setattr(registration, "count_views_with_depth", count_views_with_depth)
    monkeypatch.setattr(registration, "MIN_POINTS", 1000)
    found = register(space, SETTINGS)
    assert found.models == ()
    assert found.missing == tuple(space.files)


def test_a_plain_model_that_explains_the_matches_is_taken_before_a_room_is_looked_for(told, space):
    answers = told([EVERY], inlier_ratio=[0.95], rest=ROOM, around=MOVED)
    found = register(space, SETTINGS)
    assert answers.asked == []
    assert not found.background
    assert found.around == ()


def test_another_explanation_is_taken_where_it_explains_clearly_more(told, space):
    answers = told([EVERY, EVERY], inlier_ratio=[0.7, 0.98], around=MOVED)
    assert register(space, SETTINGS).around == MOVED
    assert answers.databases == ["database.db", "other.db"]
    assert (space.folder / "other.db").read_bytes() == b"features and matches"
    told([EVERY, EVERY], inlier_ratio=[0.85, 0.94], around=MOVED)
    assert register(space, SETTINGS).around == ()


def test_an_explanation_that_loses_photographs_does_not_beat_the_plain_one(told, space):
    some = [EVERY, *4 * [[0, 1, 2]]]
    told(some, inlier_ratio=[0.7, *4 * [0.5]], around=MOVED)
    found = register(space, SETTINGS)
    assert not found.missing
    assert found.around == ()


def test_a_room_is_left_out_where_the_plain_model_is_doubtful(told, space, monkeypatch):
    told([EVERY, EVERY], rest=ROOM)
    doubts = ["follows a camera in its place", ""]
    monkeypatch.setattr(registration, "diagnose", lambda model, count: doubts.pop(0))
    with pytest.warns(PimperWarning, match="5 of 10 features are static"):
        found = register(space, SETTINGS)
    assert len(found.background) == 5
    assert found.inlier_ratio == 1


def test_of_many_photographs_likely_pairs_are_matched_first(told, space, monkeypatch):
    answers = told([[0, 1, 2, 4], EVERY], [{"c 1.png": 0.1}, {}])
    monkeypatch.setattr(registration, "MOST_PAIRED", 4)
    monkeypatch.setattr(registration, "pairs_to_match", lambda space: NEIGHBOURS[1])
    found = register(space, SETTINGS)
    assert found.complete
    apart = [pair for pair in all_pairs(5) if {2, 3} & set(pair)]
    assert answers.matched == [(False, NEIGHBOURS[1]), NEIGHBOURS, (False, apart), (True, apart)]
