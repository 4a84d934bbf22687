"""Pairs of guided matching, and restarts of the mapper."""

from dataclasses import replace

import pytest
import torch

from pimper_torch.records.sparse_model import select_views
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.stages.sfm import registration
from pimper_torch.stages.sfm.diagnose import count_views_with_depth
from pimper_torch.stages.sfm.features import Workspace
from pimper_torch.stages.sfm.matching import VerifiedPair, all_pairs
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.stages.sfm.registration import register_photographs
from pimper_torch.stages.sfm.static_background import StaticBackground

SETTINGS = ReconstructConfig(guided_pairs=1, starts=2, seed=5, threads=1)

RIGID = StaticBackground(features=(), static_fraction=0.0, moving_pairs=0, violating_fraction=0.0)
BACKGROUND = RIGID.replace(features=5 * (torch.tensor([True, False]),), violating_fraction=0.5)

NOTHING = torch.zeros(3, 2).double()
MOVED = (VerifiedPair(views=(0, 1), first=NOTHING, second=NOTHING),)


class Scripted:
    """Calls of matcher and mapper, with scripted results of mapper and verification."""

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
        self.databases.append(space.database.name)
        return [self.models.pop(0)]

    def judge(self, model, files, pairs, max_error_px):
        inlier_ratio = self.inlier_ratio.pop(0) if self.inlier_ratio else 1.0
        return inlier_ratio, self.misplaced.pop(0) if self.misplaced else {}


@pytest.fixture
def scripted(model, monkeypatch):
    """Five photographs whose neighbours share most matches."""

    def note(numbers, misplaced=(), inlier_ratio=(), rest=RIGID, around=()):
        answers = Scripted([select_views(model, some) for some in numbers], misplaced, inlier_ratio)

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
    return Workspace(
        folder=tmp_path,
        images=tmp_path,
        files=model.names,
        masks=None,
        database=tmp_path / "database.db",
    )


NEIGHBOURS = (True, [(0, 1), (1, 2), (2, 3), (3, 4)])
EVERY = range(5)


@pytest.mark.parametrize(
    ("models", "misplaced", "guided", "seeds"),
    [
        ([EVERY], [], [], [5]),  # a complete first model is the last
        # Pairs of missing photographs, then a restart of the mapper.
        ([[0, 1, 2, 4]] * 2 + [EVERY], [], [[(0, 3), (1, 3), (2, 3), (3, 4)]], [5, 5, 6]),
        ([EVERY, EVERY], [{"d.jpg": 0.1}], [all_pairs(5)], [5, 5]),  # every pair
    ],
)
def test_the_mapper_restarts_until_all_views_are_registered(
    scripted, space, models, misplaced, guided, seeds
):
    answers = scripted(models, misplaced)
    assert register_photographs(space, SETTINGS).complete
    assert answers.matched == [
        (False, all_pairs(5)),
        NEIGHBOURS,
        *((True, pairs) for pairs in guided),
    ]
    assert answers.mapped == [(seed, False) for seed in seeds]


def test_two_view_points_are_used_last_and_the_best_model_is_kept(scripted, space):
    some = [[0, 1, 2], [0, 1, 2, 4], EVERY, [0, 1, 2]]
    answers = scripted(some, [{}, {}, {"a.jpg": 0.1, "d.jpg": 0.2}, {}])
    found = register_photographs(space, SETTINGS)
    assert answers.mapped == [(5, False), (5, False), (6, False), (5, True)]
    # Four well-placed views are better than five of which two are misplaced.
    assert found.missing == ("d.jpg",)
    assert not found.misplaced


def test_without_starts_the_first_model_is_kept(scripted, space):
    answers = scripted([[0, 1, 2]])
    settings = replace(SETTINGS, guided_pairs=0, starts=0)
    assert register_photographs(space, settings).missing == ("d.jpg", "ü.tif")
    assert answers.matched == [(False, all_pairs(5))]


def test_a_model_without_views_of_enough_points_is_rejected(scripted, space, monkeypatch):
    scripted(4 * [[0, 1]])
    monkeypatch.setattr(registration, "count_views_with_depth", count_views_with_depth)
    monkeypatch.setattr(registration, "MIN_POINTS", 1000)
    found = register_photographs(space, SETTINGS)
    assert found.models == ()
    assert found.missing == tuple(space.files)


def test_a_plain_model_with_enough_inliers_skips_the_background_search(scripted, space):
    answers = scripted([EVERY], inlier_ratio=[0.95], rest=BACKGROUND, around=MOVED)
    found = register_photographs(space, SETTINGS)
    assert answers.asked == []
    assert not found.background
    assert found.around == ()


def test_linked_sessions_are_used_if_they_have_clearly_more_inliers(scripted, space):
    answers = scripted([EVERY, EVERY], inlier_ratio=[0.7, 0.98], around=MOVED)
    assert register_photographs(space, SETTINGS).around == MOVED
    assert answers.databases == ["database.db", "other.db"]
    assert (space.folder / "other.db").read_bytes() == b"features and matches"
    scripted([EVERY, EVERY], inlier_ratio=[0.85, 0.94], around=MOVED)
    assert register_photographs(space, SETTINGS).around == ()


def test_a_model_that_loses_photographs_is_not_preferred(scripted, space):
    some = [EVERY, *4 * [[0, 1, 2]]]
    scripted(some, inlier_ratio=[0.7, *4 * [0.5]], around=MOVED)
    found = register_photographs(space, SETTINGS)
    assert not found.missing
    assert found.around == ()


def test_a_background_is_removed_if_the_plain_model_is_unreliable(scripted, space, monkeypatch):
    scripted([EVERY, EVERY], rest=BACKGROUND)
    doubts = ["follows a camera in its place", ""]
    monkeypatch.setattr(registration, "diagnose", lambda model, count: doubts.pop(0))
    with pytest.warns(PimperWarning, match="5 of 10 features are static"):
        found = register_photographs(space, SETTINGS)
    assert len(found.background) == 5
    assert found.inlier_ratio == 1


def test_likely_pairs_of_many_photographs_are_matched_first(scripted, space, monkeypatch):
    answers = scripted([[0, 1, 2, 4], EVERY], [{"c 1.png": 0.1}, {}])
    monkeypatch.setattr(registration, "MOST_PAIRED", 4)
    monkeypatch.setattr(registration, "pairs_to_match", lambda space: NEIGHBOURS[1])
    found = register_photographs(space, SETTINGS)
    assert found.complete
    apart = [pair for pair in all_pairs(5) if {2, 3} & set(pair)]
    assert answers.matched == [(False, NEIGHBOURS[1]), NEIGHBOURS, (False, apart), (True, apart)]
