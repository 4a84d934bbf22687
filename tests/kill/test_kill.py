"""Ten of the runs that `tests/kill/runs.py` ends at random moments."""

import sys
from pathlib import Path

import pytest

from tests.kill.runs import ended_runs

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="needs fork, mount and /proc"),
]


def test_nothing_is_lost_whatever_ends_a_run(tmp_path: Path):
    ended = list(ended_runs(tmp_path, count=10, seed=45))
    assert [one for one in ended if one.faults] == []
    assert any(one.exit_code < 0 for one in ended)  # or nothing was ended
