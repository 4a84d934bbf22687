"""How a chain calls its stages."""

import pytest
import torch
from probes import small_scene
from torch import nn

import pimper_torch as pt
from pimper_torch.chains.running import ChainRun, _beside
from pimper_torch.runtime.errors import PimperWarning, caution
from pimper_torch.runtime.reporting import SilentObserver, observed
from pimper_torch.store import Store


class Noting(nn.Module):
    """Returns its inputs as a list, and emits a warning at every call."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0

    def forward(self, *given):
        self.calls += 1
        caution(f"call {self.calls}")
        return [*given]


@pytest.fixture
def stages():
    return {name: Noting() for name in ("warp", "factorize", "sweep", "fuse")}


def running(stages):
    return ChainRun(names={one: name for name, one in stages.items()}, store=None)


def test_only_the_last_pass_warns_unless_one_fails(stages):
    run = running(stages)
    with pytest.warns(PimperWarning) as caught:
        found = [run(stages["fuse"], *one) for one in run.passes((0.25, 0.5, 1.0))]
    assert found == [[0.25, False], [0.5, False], [1.0, True]]
    assert [str(one.message) for one in caught] == ["call 3"]

    def broken():
        caution("before it broke")
        raise ValueError("broken")

    next(run.passes((0.5, 1.0)))
    with pytest.warns(PimperWarning, match="before it broke"), pytest.raises(ValueError):  # noqa: PT011
        run(broken)


def test_keywords_reach_the_stage_by_name(stages):
    class Named(nn.Module):
        def forward(self, first, expected=1, most=2):
            return first, expected, most

    assert running(stages)(Named(), 0, most=3) == (0, 1, 3)


@pytest.mark.parametrize("behind", [(), (pt.Given,)], ids=["alone", "before another stage"])
def test_a_stage_says_whether_its_record_is_kept_also_in_a_sequence(behind):
    mesh = small_scene(num_views=4, width=32, num_points=17)[1].mesh
    stage = pt.stages.Simplify()
    stage = pt.Then(stage, *(kind(stage(mesh, pt.MeshFiles())) for kind in behind))
    assert (stage.kept_as is pt.records.FinishedMesh) == (not behind)


def test_the_record_of_a_sequence_and_of_keywords_is_read_by_a_later_run(tmp_path):
    stage = pt.Then(pt.stages.Simplify())
    mesh = small_scene(num_views=4, width=32, num_points=17)[1].mesh
    found, kept = [], []
    for files in (pt.MeshFiles(), pt.MeshFiles(), pt.MeshFiles(watertight=True)):
        run = ChainRun(names={stage: "simplify"}, store=Store(folder=tmp_path))
        with observed(SilentObserver()) as table:
            found.append(run(stage, mesh, files=files))
        kept.append(next(report.kept for report in table.reports if report.name == "simplify"))
    assert kept == [False, True, False]
    assert torch.equal(found[0].mesh.vertices_world, found[1].mesh.vertices_world)
    assert found[0].closed is None
    assert found[2].closed is not None


def test_a_kept_record_is_on_the_device_of_the_inputs_also_of_keywords():
    record = small_scene(num_views=4, width=32, num_points=17)[1].mesh
    elsewhere = record.to("meta")
    assert _beside(elsewhere, (1, "no records")) is elsewhere
    assert _beside(record, ("text", elsewhere)).faces.device.type == "meta"
