"""The benchmark script benchmarks/studies/speed.py."""

import importlib.util
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from torch.testing import assert_close

from pimper_bench.table.measure import peak_memory
from pimper_torch.records import StageReport

MB = 2**20


@pytest.fixture(scope="module")
def speed():
    path = Path(__file__).parents[2] / "benchmarks" / "studies" / "speed.py"
    spec = importlib.util.spec_from_file_location("speed", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["speed"] = module  # dataclasses look up their module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["speed"]


def report(stage, **figures):
    return StageReport(name=stage, seconds=0.0, peak_memory_mb=0.0, figures=figures)


def test_passes_of_a_stage_are_summed_and_peaks_are_not(speed):
    first, other, again = (
        speed.Cost(stage=stage, seconds=2, cpu_seconds=3, page_faults=5, peak_mb=peak)
        for stage, peak in (("warp", 70.0), ("fuse", 90.0), ("warp", 60.0))
    )
    warp, fuse = speed.by_stage([first, other, again])
    assert (warp.stage, warp.seconds, warp.cpu_seconds, warp.page_faults) == ("warp", 4, 6, 10)
    assert (warp.peak_mb, fuse.seconds, fuse.peak_mb) == (70.0, 2, 90.0)


def test_a_pass_without_a_lower_bound_has_the_ratio_of_the_others(speed):
    iterations = [
        speed.Cost(stage="fuse", seconds=seconds, cpu_seconds=1, page_faults=0, floor_seconds=floor)
        for seconds, floor in ((6.0, math.nan), (10.0, 0.1), (30.0, 0.7))
    ]
    found = speed.added("fuse", iterations)
    assert_close(found.seconds / found.floor_seconds, (10 + 30) / (0.1 + 0.7))
    assert math.isnan(speed.added("fuse", iterations[:1]).floor_seconds)


def test_a_stage_has_its_own_peak_although_others_start_within_it(speed):
    with peak_memory() as peak:
        if peak() is None:
            pytest.skip("this system does not let a process forget its peak")
    meter = speed.Meter()
    meter.started("outer")
    held = np.ones(300 * MB, dtype=np.uint8)
    assert held.sum() == 300 * MB
    del held
    meter.started("inner")
    meter.finished(report("inner"))
    meter.finished(report("outer"))
    inner, outer = meter.costs
    assert (inner.stage, outer.stage) == ("inner", "outer")
    assert outer.peak_mb - inner.peak_mb > 250
    assert outer.page_faults > inner.page_faults
    assert outer.seconds > inner.seconds > 0


@pytest.mark.usefixtures("small_pictures")
def test_a_run_is_measured_saved_and_compared(speed, reconstruction, monkeypatch, tmp_path, capsys):
    class Chain:
        """The stage calls of a run, without the computation."""

        def __init__(self, config, observer, cache):
            self.observer = observer

        def __call__(self, views, sparse_model):
            for stage, figures in (
                ("reconstruct", {}),
                ("decompose", {"patches": 7, "template_samples": 100}),
                ("warp", {}),
                ("fuse", {}),
            ):
                self.observer.started(stage)
                self.observer.finished(report(stage, **figures))
            return reconstruction

    monkeypatch.setattr(speed, "make_chain", Chain)
    monkeypatch.setattr(speed, "load_views", lambda *_, **__: reconstruction.scene.views)
    monkeypatch.setattr(speed, "copy_bytes_per_s", lambda: 1e9)
    figures = tmp_path / "figures.json"
    earlier = tmp_path / "earlier.json"
    fused = speed.Cost(stage="fuse", seconds=1, cpu_seconds=1, page_faults=1, peak_mb=1.0)
    earlier.write_text(json.dumps({"costs": [speed.asdict(fused)]}), encoding="utf-8")
    options = ["--preset", "fast", "--scales", "--against", str(earlier)]
    speed.main(["demo", *options, "-o", str(figures)])
    kept = json.loads(figures.read_text(encoding="utf-8"))
    assert [cost["stage"] for cost in kept["costs"]] == [
        *("import", "read", "reconstruct", "decompose", "warp", "fuse", "aside", "write"),
    ]
    assert kept["preset"] == "fast"
    assert kept["entries"] == [100 * reconstruction.scene.views.num_views]
    assert kept["costs"][4]["floor_seconds"] == 13e-9 * kept["entries"][0]
    assert kept["written_mb"] > 0
    after = speed.cost_rows(kept)[-2]
    assert after.seconds < speed.cost_rows(kept)[-1].seconds
    assert after.seconds > kept["costs"][-1]["seconds"]
    whole = speed.cost_rows(kept)[-1].seconds
    assert whole == pytest.approx(kept["clock_seconds"], abs=0.1 + 0.02 * whole)  # complete
    printed = capsys.readouterr().out
    measured, compared = printed.split("Over the earlier run's")
    assert measured.count("| fuse |") == compared.count("| fuse |") == 1
    assert "s are in no line: " in measured
    assert "| fuse | - |" not in compared
    assert "| write | - | - | - | - |" in compared  # the earlier run had none


def test_scaling_runs_halves_of_the_size(speed, monkeypatch, tmp_path, capsys):
    def run(command, **_):
        out = Path(command[command.index("-o") + 1])
        size = int(command[-1])
        costs = [
            speed.asdict(
                speed.Cost(
                    stage="warp",
                    seconds=size**2,
                    cpu_seconds=size**2,
                    page_faults=0,
                    peak_mb=5.0,
                )
            )
        ]
        machine = {"cores": 2}
        found = {"entries": [size**2], "patches": [size], "machine": machine, "costs": costs}
        out.write_text(json.dumps(found), encoding="utf-8")

    monkeypatch.setattr(speed.subprocess, "run", run)
    speed.main(["demo", "--scaling", "--max-size-px", "400"])
    printed = capsys.readouterr().out
    assert "| warp | 40000.0 / 80089.0 / 160000.0 | 1 | 5 / 5 / 5 | 0 | 0 |" in printed
