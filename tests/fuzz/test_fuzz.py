"""Damaged files of every kind: a clean error or a sound result, in little memory and time."""

import subprocess
import sys
from pathlib import Path

import pytest

RUN = Path(__file__).parent / "run.py"


@pytest.mark.parametrize(
    ("count", "seed"), [(250, 1), pytest.param(5000, 2, marks=pytest.mark.slow)]
)
def test_damaged_files_end_in_clean_errors_or_sound_results(count, seed):
    ran = subprocess.run(
        [sys.executable, RUN, "--count", str(count), "--seed", str(seed)],
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stdout[-3000:] + ran.stderr[-3000:]
    assert f"{count} files, 0 failures" in ran.stdout
