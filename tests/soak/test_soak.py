import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.soak.soak import grown


@pytest.mark.slow
def test_a_process_holds_no_more_after_four_runs_than_after_two():
    root = Path(__file__).parents[2]
    ran = subprocess.run(
        [sys.executable, str(root / "tests" / "soak" / "soak.py"), "--runs", "4"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "nothing grew" in ran.stdout


def test_whatever_grows_is_told():
    settled = {"memory": 1000.0, "threads": 4, "handles": 9, "temporary files": 0}
    first = dict.fromkeys(settled, 1)
    assert not grown([first, settled, settled | {"memory": 1029.0}])
    for change in ({"memory": 1031.0}, {"threads": 5}, {"handles": 10}, {"temporary files": 1}):
        assert len(grown([first, settled, settled | change])) == 1
