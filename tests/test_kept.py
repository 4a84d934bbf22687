"""Runs resume where an earlier one ended."""

import pytest
import torch
from probes import small_scene

import pimper_torch as pt
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.reporting import SilentObserver
from pimper_torch.store import digest

pytestmark = pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")

# Two passes over given facets, in order.
STAGES = ["silhouettes", "light", "depth_from_light", "photometry", "fuse", "remesh"]
STAGES += ["light", "photometry", "fuse", "extract", "judge"]


class Listener(SilentObserver):
    def __init__(self) -> None:
        self.reports = []

    def finished(self, report):
        self.reports.append(report)

    @property
    def kept(self):
        return [report.name for report in self.reports if report.kept]

    @property
    def done(self):
        return [report.name for report in self.reports if not report.kept]


@pytest.fixture(scope="module")
def given():
    return tuple(each.to(torch.float32) for each in small_scene(num_views=6, width=48))


def chain_of(given, store, **changes):
    listener = Listener()
    settings = {"scales": [0.25, 0.5], "silhouettes": {"object": "everything"}, **changes}
    scene, coarse = given
    stages = {"reconstruct": pt.Given(scene), "coarse_surface": pt.Given(coarse)}
    return pt.load_chain("default", settings, listener, store, **stages), listener


def run(given, store, **changes):
    chain, listener = chain_of(given, store, **changes)
    return chain(given[0].views), listener


@pytest.fixture(scope="module")
def whole(given, tmp_path_factory):
    """An uninterrupted run without a store, and the store of a second run."""
    folder = tmp_path_factory.mktemp("kept")
    result, listener = run(given, folder)
    assert listener.kept == []
    return run(given, None)[0], folder, result


def bits(result):
    return digest(result.replace(report=()))


def test_a_store_does_not_change_the_result(whole):
    without, _, keeping = whole
    assert bits(keeping) == bits(without) is not None
    assert keeping.left_out == without.left_out
    guards = [entry.guard for entry in without.left_out]
    assert guards.count("remesh.data") == 1
    assert guards.count("fuse.support") == guards.count("photometry.undetermined") == 2
    assert guards[-1] == "extract.pieces"


@pytest.mark.parametrize("done", [1, 3, 6])
def test_a_run_resumes_after_any_stage_with_the_same_bits(given, whole, tmp_path, done):
    expected, folder, _ = whole
    paths = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)
    assert [path.name.split("-")[0] for path in paths] == STAGES
    for path in paths[:done]:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    result, listener = run(given, tmp_path)
    assert bits(result) == bits(expected)
    assert listener.kept == STAGES[:done]
    assert [name for name in listener.done if name in STAGES] == STAGES[done:]


def test_a_changed_setting_reruns_its_dependent_stages(given, whole):
    _, folder, _ = whole
    _, listener = run(given, folder, extract={"max_hole": 0.3})
    assert "extract" in listener.done
    assert listener.kept.count("photometry") == 2
    _, listener = run(given, folder, factorize={"light_prior": 2.0})
    assert listener.kept == STAGES[:3]
    # The first pass does not depend on the scale of the second.
    _, listener = run(given, folder, scales=[0.25, 0.4])
    assert listener.kept == STAGES[:6]


def test_different_photographs_rerun_everything(given, whole):
    _, folder, _ = whole
    scene, coarse = given
    brighter = scene.views.replace(images=scene.views.images * 1.001)
    _, listener = run((scene.replace(views=brighter), coarse), folder)
    assert "photometry" not in listener.kept


class Subclassed(pt.Extract):
    """The package's stage, subclassed in a different module."""

    def forward(self, surface: pt.Surface) -> pt.Mesh:
        caution("doubtful")
        return super().forward(surface)


def test_a_custom_stage_is_called_every_time(given, whole):
    _, folder, _ = whole
    chain, listener = chain_of(given, folder)
    chain.extract = Subclassed()
    for _ in range(2):
        with pytest.warns(pt.PimperWarning, match="doubtful"):
            chain(given[0].views)
    assert listener.done.count("extract") == 2


def test_an_unwritable_store_does_not_end_a_run(given, whole, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.warns(pt.PimperWarning, match=r"cannot be kept there.*Free space"):
        result, _ = run(given, tmp_path / "file" / "folder")
    assert bits(result) == bits(whole[0])
