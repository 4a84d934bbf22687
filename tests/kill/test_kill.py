"""Six runs of `tests/kill/runs.py`, ended at random moments."""

import subprocess
import sys
from pathlib import Path

import pytest

# In a new process: one with threads cannot be forked.
RUNS = Path(__file__).with_name("runs.py")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs fork and /proc")
def test_no_result_is_lost_however_a_run_ends():
    line = [sys.executable, str(RUNS), "6", "45"]
    ran = subprocess.run(line, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "exit   -9" in ran.stdout  # or no run was killed
