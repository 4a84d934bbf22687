import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch

from pimper_torch.chains.running import called
from pimper_torch.records import Mesh, StageReport
from pimper_torch.runtime import reporting
from pimper_torch.runtime.progress import report
from pimper_torch.runtime.reporting import (
    SilentObserver,
    add_counts,
    aside,
    observed,
    seconds_of,
    stage,
    table_of,
)
from pimper_torch.runtime.stream import emit


def tetrahedron() -> Mesh:
    report(1, 1)
    add_counts({"openings": 0})
    faces = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    return Mesh(vertices_world=torch.eye(4)[:, :3].contiguous(), faces=faces)


def broken() -> Mesh:
    raise ValueError("broken on purpose")


class Listener(SilentObserver):
    def __init__(self) -> None:
        self.heard: list[str] = []

    def started(self, stage):
        self.heard.append(f"started {stage}")

    def progressed(self, done, total):
        self.heard.append(f"{done}/{total}")

    def finished(self, report):
        self.heard.append(f"finished {report.name}")


def test_stages_are_reported_in_order_with_their_figures():
    listener = Listener()
    with observed(listener) as table:
        called("second", tetrahedron)
        called("first", tetrahedron)
    assert [entry.name for entry in table.reports] == ["second", "first", "between stages"]
    assert table.reports[0].figures == {"vertices": 4, "faces": 4, "openings": 0}
    assert all(entry.seconds >= 0 and entry.peak_memory_mb > 10 for entry in table.reports)
    assert listener.heard[:3] == ["started second", "1/1", "finished second"]


def test_failed_and_nested_stages_have_no_report():
    listener = Listener()
    with observed(listener):
        with pytest.raises(ValueError, match="on purpose"):
            called("broken", broken)
        called("outer", lambda: called("inner", tetrahedron))
    assert listener.heard == ["started broken", "started outer", "1/1", "finished outer"]


def test_threads_have_separate_reports():
    names = {}
    inside = threading.Barrier(2, timeout=60)
    listeners = {"first": Listener(), "second": Listener()}

    def call(stage):
        with observed(listeners[stage]) as table:
            inside.wait()
            called(stage, tetrahedron)
            inside.wait()
        names[stage] = [entry.name for entry in table.reports]

    threads = [threading.Thread(target=call, args=(stage,)) for stage in listeners]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert names == {name: [name, "between stages"] for name in listeners}
    for name, listener in listeners.items():
        assert listener.heard == [f"started {name}", "1/1", f"finished {name}"]


class Clock:
    now = 100.0

    def perf_counter(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def test_times_of_stages_sum_to_the_time_of_the_call(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(reporting, "time", clock)
    kept = StageReport(name="kept", seconds=1e6, peak_memory_mb=0.0, figures={}, kept=True)
    with observed(SilentObserver()) as table:
        with stage("read"), aside("keep"):  # counts as time of the stage
            clock.sleep(1)
        for _ in range(2):
            with observed(SilentObserver()):
                with aside("keep"):
                    clock.sleep(2)
                called("first", tetrahedron)
                emit(kept)
                clock.sleep(4)
        so_far = table.so_far()
        clock.sleep(8)
    lines = [(line.name, 0 if line.kept else line.seconds) for line in table_of(table.reports)]
    again = [("first", 0), ("kept", 0)] * 2
    assert lines == [("read", 1), *again, ("keep", 4), ("between stages", 16)]
    assert seconds_of(table.reports) == clock.now - 100
    assert seconds_of(so_far) == clock.now - 108


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="asks Linux what is resident")
def test_peak_memory_rises_by_the_allocation_and_does_not_fall():
    """In a new process: pages of a long-running one may be reclaimed or reused."""
    source = """
import mmap, pathlib, torch
from pimper_torch.runtime.reporting import peak_memory_mb
before = peak_memory_mb()
pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
held = torch.ones(int(before - pages * mmap.PAGESIZE / 2**20 + 64) * 2**20 // 4)
risen = peak_memory_mb()
del held
print(before, risen, peak_memory_mb())
"""
    command = [sys.executable, "-c", source]
    answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    before, risen, after = map(float, answer.split())
    assert risen - before == pytest.approx(64, abs=8)  # the interpreter's allocations
    assert after == pytest.approx(risen, abs=8)


def test_a_value_other_than_a_record_reports_no_figures():
    with observed(SilentObserver()) as table:
        called("stage", lambda: "nothing of ours")
    assert table.reports[0].figures == {}
