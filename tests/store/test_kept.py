"""Messages from the computation of a record are repeated when it is read from the store."""

import pytest
import torch

from pimper_torch.chains.running import called
from pimper_torch.records import Cameras, Failure
from pimper_torch.runtime.errors import PimperWarning, caution
from pimper_torch.runtime.events import Caution, Removal
from pimper_torch.runtime.failures import skipped, skipping
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.reporting import SilentObserver, observed
from pimper_torch.runtime.stream import collected
from pimper_torch.store import Store, digest, kept


def cameras():
    return Cameras(
        intrinsics=torch.eye(3).repeat(2, 1, 1),
        cam_from_world=torch.eye(4).repeat(2, 1, 1),
        sizes_px=torch.tensor([[80, 60]] * 2),
    )


FAILURE = Failure(stage="warp", what="patch", name="3", reason="numbers", done="Left out")


def found(store):
    """Return the record, its messages, and whether it was computed, and reported as kept."""
    made = []

    def make():
        made.append(1)
        caution("doubtful")
        skipped(FAILURE)
        leave_out("silhouettes.empty", torch.tensor([True, False]), names=("a", "b"))
        return cameras()

    with (
        pytest.warns(PimperWarning, match="doubtful"),
        skipping(),
        observed(SilentObserver()) as table,
        collected(Caution, Failure, Removal, passed_on=True) as told,
    ):
        record, _ = kept(store, "key", Cameras, lambda: called("stage", make))
    (report,) = (report for report in table.reports if report.name == "stage")
    return record, told, bool(made), report.kept


def test_stored_records_replay_cautions_failures_guards_and_reports(tmp_path):
    first, second = (found(Store(folder=tmp_path)) for _ in range(2))
    assert digest(first[0]) == digest(second[0])
    assert [type(event) for event in first[1]] == [Caution, Failure, Removal]
    assert first[1] == second[1]
    assert first[2:] == (True, False)
    assert second[2:] == (False, True)


def test_a_record_without_a_key_is_recomputed(tmp_path):
    for _ in range(2):
        kept(Store(folder=tmp_path), None, Cameras, cameras)
    assert list(tmp_path.iterdir()) == []
