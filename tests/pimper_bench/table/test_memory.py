import sys

import numpy as np
import pytest

from pimper_bench.table import measure
from pimper_bench.table.measure import peak_memory

MB = 2**20


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forgets a peak")
def test_a_method_does_not_inherit_the_memory_peak_of_the_previous_one():
    with peak_memory() as peak:
        if peak() is None:
            pytest.skip("this system does not let a process forget its peak")
        before = peak()
        held = np.ones(400 * MB, dtype=np.uint8)
        assert held.sum() == 400 * MB
        del held
        greedy = peak()
    with peak_memory() as peak:
        frugal = peak()
    assert greedy - before > 350
    assert greedy - frugal > 350


def test_memory_is_unknown_if_the_system_does_not_report_it(monkeypatch, tmp_path):
    monkeypatch.setattr(measure, "_SELF", tmp_path / "none")
    with peak_memory() as peak:
        assert peak() is None
