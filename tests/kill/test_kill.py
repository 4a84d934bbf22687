"""Six of the runs that `tests/kill/runs.py` ends at random moments."""

import subprocess
import sys
from pathlib import Path

import pytest

# In a process of its own: one that has threads cannot be forked.
RUNS = Path(__file__).with_name("runs.py")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs fork and /proc")
def test_nothing_is_lost_whatever_ends_a_run():
    line = [sys.executable, str(RUNS), "6", "45"]
    ran = subprocess.run(line, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "exit   -9" in ran.stdout  # or nothing was ended
