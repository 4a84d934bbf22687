"""Number of cores that a process may use, in containers and with an affinity mask."""

import os

import pytest

from pimper_torch.cli.main import main
from pimper_torch.runtime.cores import usable_cores
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig


@pytest.fixture(autouse=True)
def machine(monkeypatch, tmp_path):
    """Set 64 processors, and no limit."""
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr("pimper_torch.runtime.cores._CGROUP", tmp_path)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, 8),
        ({"cpu.max": "max 100000"}, 8),
        ({"cpu.max": "200000 100000"}, 2),
        ({"cpu.max": "150000 100000"}, 2),
        ({"cpu.max": "5000 100000"}, 1),
        ({"cpu.max": "6400000 100000"}, 8),
        ({"cpu.max": "damaged"}, 8),
        ({"cpu/cpu.cfs_quota_us": "300000", "cpu/cpu.cfs_period_us": "100000"}, 3),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 8),
        ({"cpu/cpu.cfs_quota_us": "300000"}, 8),
    ],
)
def test_affinity_and_quota_limit_cores(files, cores, monkeypatch, tmp_path):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    (tmp_path / "cpu").mkdir()
    for name, text in files.items():
        (tmp_path / name).write_text(f"{text}\n")
    assert usable_cores() == cores
    config = ReconstructConfig()
    assert config.num_threads == cores
    assert ReconstructConfig(threads=5).num_threads == 5


def test_without_affinity_all_cores_are_used(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    for count, cores in ((6, 6), (None, 1)):
        monkeypatch.setattr(os, "cpu_count", lambda count=count: count)
        assert usable_cores() == cores


@pytest.mark.parametrize(("value", "cores"), [("3", 3), ("99", 8), ("0", 1), ("4,2", 8), ("", 8)])
def test_a_given_number_of_threads_limits_cores(value, cores, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    assert usable_cores() == cores


def test_a_quota_limits_the_threads_of_torch(monkeypatch, capsys, tmp_path):
    (tmp_path / "cpu.max").write_text("100000 100000")
    assert main(["config"]) == 0
    assert os.environ.pop("OMP_NUM_THREADS") == "1"
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert main(["config"]) == 0
    assert os.environ["OMP_NUM_THREADS"] == "3"
