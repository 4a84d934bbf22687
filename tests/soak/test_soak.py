import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_memory_after_four_runs_equals_that_after_two():
    soak = Path(__file__).with_name("soak.py")
    environment = {**os.environ, "PYTHONPATH": str(soak.parents[2])}
    line = [sys.executable, str(soak), "4"]
    ran = subprocess.run(line, capture_output=True, text=True, env=environment)
    assert ran.returncode == 0, ran.stdout + ran.stderr
