"""Removals are recorded with guard, count and reason, without changing results."""

import re
from pathlib import Path

import pytest
import torch

import pimper_torch
from pimper_torch.records import Failure, Removal
from pimper_torch.runtime.failures import skipped, skipping
from pimper_torch.runtime.ledger import GUARDS, RemovedElements, closing_line, leave_out
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.runtime.stream import collected

FAILED = Failure(stage="warp", what="patch", name="3", reason="numbers", done="Left out")


def entry(guard, count, total, names=()):
    what, reason = GUARDS[guard]
    return Removal(guard=guard, what=what, count=count, total=total, reason=reason, names=names)


def test_a_mask_is_counted_and_names_are_those_of_its_photographs():
    with skipping() as entries:
        leave_out("silhouettes.empty", torch.tensor([True, False, True]), names=("a", "b", "c"))
        leave_out("extract.borders", torch.tensor([False, True, False, False]))
        leave_out("sfm.missing", 1, total=8, names=["d"])
        leave_out("sfm.diagnosis", bool("why"))
    assert entries == [
        entry("silhouettes.empty", 2, 3, ("a", "c")),
        entry("extract.borders", 1, 4),
        entry("sfm.missing", 1, 8, ("d",)),
        entry("sfm.diagnosis", 1, 1),
    ]


def test_outside_a_run_no_removal_is_recorded():
    with collected(Removal, passed_on=True) as entries:
        leave_out("extract.borders", torch.ones(3, dtype=torch.bool))
    assert entries == []


@pytest.mark.parametrize("threads", [1, 3])
def test_removals_of_threads_are_summed_per_guard_and_call(threads, monkeypatch):
    monkeypatch.setattr("pimper_torch.runtime.parallel.num_workers", lambda: threads)

    def work(number):
        leave_out("warp", number, total=10)
        leave_out("photometry.robust", torch.arange(10) < number)
        if number == 3:
            skipped(FAILED)
        return number

    with skipping() as entries:
        leave_out("warp", 5, total=10)
        for _ in range(2):
            assert list(side_by_side(work, range(6))) == list(range(6))
    one_pass = [FAILED, entry("photometry.robust", 15, 60), entry("warp", 15, 60)]
    assert entries == [entry("warp", 5, 10), *one_pass, *one_pass]


def test_a_listener_receives_masks_and_positions_from_threads():
    vertices = torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 3]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    mask = torch.tensor([True, False])

    def work(number):
        leave_out("extract.pieces", mask, at=(vertices, faces))
        leave_out("repair", mask[:1], at=vertices[:1])
        leave_out("sfm.tracks", 1, total=3)

    with collected(RemovedElements) as heard:
        list(side_by_side(work, [0]))
    leave_out("extract.pieces", mask)
    pieces, folds, tracks = heard
    assert (pieces.removal.count, pieces.removal.total) == (1, 2)
    assert pieces.mask is mask
    assert pieces.places().tolist() == [[1, 1, 0], [0, 1, 1]]
    assert folds.places().tolist() == [[0, 0, 0]]
    assert tracks.mask is tracks.places() is None


def test_the_closing_line_names_photographs_and_removals_above_five_percent():
    left_out = [
        entry("sfm.missing", 2, 8, ("IMG_1", "IMG_2")),
        entry("remesh.data", 500, 1000),
        entry("warp", 90, 100),
        entry("sfm.diagnosis", 1, 1),
        entry("remesh.data", 60, 1000),
        entry("extract.spikes", 5, 100),
        entry("extract.borders", 8, 100),
    ]
    assert closing_line(left_out) == (
        "Excluded: IMG_1, IMG_2 (sfm.missing); 6% of the facets (remesh.data); "
        "8% of the faces (extract.borders)."
    )
    assert closing_line([entry("warp", 90, 100), entry("sfm.missing", 0, 8)]) == ""


def test_every_guard_is_recorded_under_its_name():
    package = Path(pimper_torch.__file__).parent
    sources = [path.read_text() for path in package.rglob("*.py") if path.name != "ledger.py"]
    called = re.findall(r'"([a-z_.]+)"', " ".join(text for text in sources if "leave_out(" in text))
    assert set(GUARDS) <= set(called)
