import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch
from torch import nn

from pimper_torch.progress import report
from pimper_torch.records import Mesh
from pimper_torch.reporting import Silent, figures, recorded


class Tetrahedron(nn.Module):
    def forward(self) -> Mesh:
        report(1, 1)
        faces = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
        return Mesh(vertices_world=torch.eye(4)[:, :3].contiguous(), faces=faces)


class Broken(nn.Module):
    def forward(self) -> Mesh:
        raise ValueError("broken on purpose")


class Chain(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.first = Tetrahedron()
        self.second = Tetrahedron()
        self.broken = Broken()


class Listener(Silent):
    def __init__(self) -> None:
        self.heard: list[str] = []

    def started(self, stage):
        self.heard.append(f"started {stage}")

    def progressed(self, done, total):
        self.heard.append(f"{done}/{total}")

    def finished(self, report):
        self.heard.append(f"finished {report.name}")


def test_stages_are_reported_in_the_order_they_run_with_their_figures():
    chain, listener = Chain(), Listener()
    with recorded(chain, listener) as reports:
        chain.second()
        chain.first()
    assert [entry.name for entry in reports] == ["second", "first"]
    assert reports[0].figures == {"vertices": 4, "faces": 4, "openings": 0}
    assert all(entry.seconds >= 0 and entry.peak_memory_mb > 10 for entry in reports)
    assert listener.heard[:3] == ["started second", "1/1", "finished second"]


def test_threads_that_share_a_chain_have_reports_of_their_own():
    chain, told = Chain(), {}
    inside = threading.Barrier(2, timeout=60)
    listeners = {"first": Listener(), "second": Listener()}

    def call(stage):
        with recorded(chain, listeners[stage]) as reports:
            inside.wait()  # both have their hooks on the chain
            getattr(chain, stage)()
            inside.wait()
        told[stage] = [entry.name for entry in reports]

    threads = [threading.Thread(target=call, args=(stage,)) for stage in listeners]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert told == {"first": ["first"], "second": ["second"]}
    for stage, listener in listeners.items():
        assert listener.heard == [f"started {stage}", "1/1", f"finished {stage}"]


def test_no_hook_stays_behind_even_after_a_failure():
    chain, listener = Chain(), Listener()
    with pytest.raises(ValueError, match="on purpose"), recorded(chain, listener):
        chain.broken()
    chain.first()
    assert listener.heard == ["started broken"]


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="asks Linux what is resident")
def test_peak_memory_rises_by_what_is_allocated_and_does_not_fall():
    """In a process of its own: pages of a long one may be reclaimed or used again meanwhile."""
    source = """
import mmap, pathlib, torch
from pimper_torch.reporting import peak_memory_mb
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
    assert risen - before == pytest.approx(64, abs=8)  # the interpreter's own
    assert after == pytest.approx(risen, abs=8)


def test_what_has_no_figures_reports_none():
    assert figures("nothing of ours") == {}
