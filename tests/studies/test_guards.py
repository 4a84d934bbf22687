"""The evaluation of guards separates right from wrong removals, and its targets exist."""

import pkgutil

import pytest
import torch
from guard_sets import SETS
from guards import CHANGES, PATCHES, Heard, Judge, table

from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.presets.load_config import load_config
from pimper_torch.records import Mesh
from pimper_torch.runtime.ledger import GUARDS, leave_out
from pimper_torch.runtime.stream import listening

SQUARE = Mesh(
    vertices_world=torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]),
    faces=torch.tensor([[0, 1, 2], [0, 2, 3]]),
)


def judge(**changes):
    shown = torch.zeros(2, 4, 4, dtype=torch.bool)
    shown[:, :, :2] = True
    known = {"names": ("a", "b"), "spoilt": ["b"], "good": True, "near": 0.1, "shown": shown}
    twice = torch.diag(torch.tensor([2.0, 2, 2, 1], dtype=torch.float64))
    surface = NearestSurface(SQUARE)
    return Judge(**{**known, "truth_from_world": twice, "surface": surface, **changes})


def fractions(judge, guard, *given, **more):
    heard = Heard()
    with listening(heard):
        leave_out(guard, *given, **more)
    return [judge.right(*entry) for entry in heard.entries]


def test_removing_an_unspoilt_photograph_is_a_wrong_removal():
    both = torch.tensor([True, True])
    assert fractions(judge(), "sfm.sound_views", both, names=("a", "b")) == [0.5]
    assert fractions(judge(), "sfm.weak_views", both) == [None]


@pytest.mark.parametrize("good", [True, False])
def test_a_diagnosis_with_good_cameras_is_a_wrong_removal(good):
    assert fractions(judge(good=good), "sfm.diagnosis", 1) == [float(good)]


def test_points_near_the_true_surface_are_wrong_removals():
    places = torch.tensor([[0.2, 0.2, 0.0], [0.4, 0.4, 0.01], [0.2, 0.2, 1], [0.9, 0.2, 0]])
    taken = torch.tensor([True, True, True, False])
    (fraction,) = fractions(judge(), "repair", taken, at=places)
    assert fraction == pytest.approx(2 / 3)
    assert fractions(judge(surface=None), "repair", taken, at=places) == [None]


def test_pixels_of_the_object_are_wrong_removals():
    taken = torch.zeros(2, 8, 8, dtype=torch.bool)
    taken[:, :, 3:5] = True
    assert fractions(judge(), "silhouettes.shadows", taken) == [0.5]


def test_every_guard_and_its_replacement_exists():
    names = {*PATCHES, *CHANGES, *(guard for one in SETS.values() for guard in one.guards)}
    assert names <= set(GUARDS)
    for patches in PATCHES.values():
        for target in patches:
            assert pkgutil.resolve_name(f"pimper_torch.{target}") is not None
    for changes in CHANGES.values():
        load_config("default", changes)
    assert sum(not one.guards for one in SETS.values()) >= 20


def test_the_table_sums_only_plain_sets():
    row = {"count": 2, "total": 10, "judged": 2, "right": 1.0}
    run = {"seconds": 1.0, "failure": "", "registered": [8, 8], "guards": {"extract.borders": row}}
    keys = ("mug-arc", "jar-arc", "flaps")
    lines = list(table({(name, "fast", ""): run for name in keys}))
    assert "| extract.borders | faces | fast | 2 of 2 | 4 | 20 | 20.00 | 50 | mug-arc |" in lines
    assert "extract.borders 2 of 10 |" in next(line for line in lines if line.startswith("| flaps"))
