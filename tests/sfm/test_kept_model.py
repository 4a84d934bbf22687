"""Models that are kept from run to run."""

from pathlib import Path

import pytest
import torch

from pimper_torch.method.sfm import reconstruct
from pimper_torch.method.sfm.reconstruct import Reconstruct, find_model
from pimper_torch.method.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.runtime.errors import PimperWarning, caution
from pimper_torch.runtime.failures import collecting
from pimper_torch.runtime.ledger import leave_out, left_out_of
from pimper_torch.runtime.store import Store, digest

pytestmark = pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")


@pytest.fixture
def runs(model, monkeypatch):
    """The settings of every run of structure from motion."""
    runs = []

    def found(views, config):
        runs.append(config)
        caution("one may be misplaced")
        leave_out("sfm.tracks", len(runs), total=9)
        maps = torch.eye(3, dtype=torch.float64).repeat(5, 1, 1)
        return model.replace(background_from_view=maps)

    monkeypatch.setattr(reconstruct, "structure_from_motion", found)
    return runs


def test_structure_from_motion_runs_once_for_the_same_photographs(views, runs, tmp_path):
    first = Reconstruct(cache=tmp_path)(views)
    with pytest.warns(PimperWarning, match="misplaced"):
        second = Reconstruct(ReconstructConfig(threads=1), cache=str(tmp_path))(views)
    assert len(runs) == 1
    assert digest(first) == digest(second) is not None
    Reconstruct(ReconstructConfig(seed=1), cache=tmp_path)(views)
    Reconstruct()(views)
    assert len(runs) == 3


def test_the_seconds_are_those_in_which_it_was_found(views, runs, tmp_path):
    store = Store(folder=tmp_path)
    found = [find_model(views, ReconstructConfig(), store) for _ in range(2)]
    assert len(runs) == 1
    assert found[0][1] == found[1][1] > 0


def test_all_that_a_model_depends_on_counts(views, runs, tmp_path):
    brighter = views.images.clone()
    brighter[4, 2, 59, 79] += 1e-9
    others = [
        views,
        views.replace(images=brighter),
        views.replace(names=("z.jpg", *views.names[1:])),
        views.replace(masks=views.inside),
        views.replace(masks=~views.inside),
        views.replace(focals_px=torch.full((5,), 90.0, dtype=torch.float64)),
        views.replace(sizes_px=views.sizes_px - 1),
    ]
    elsewhere = views.replace(folder="/elsewhere")  # which does not count
    for _ in range(2):
        for other in (*others, elsewhere):
            find_model(other, ReconstructConfig(), Store(folder=tmp_path))
    assert len(runs) == len(others)


def test_photographs_that_ask_for_gradients_are_another_run_every_time(views, runs, tmp_path):
    tracked = views.replace(images=views.images.clone().requires_grad_())
    for _ in range(2):
        find_model(tracked, ReconstructConfig(), Store(folder=tmp_path))
    assert len(runs) == 2
    assert list(tmp_path.iterdir()) == []


def test_what_guards_left_out_is_entered_again(views, runs, tmp_path):
    store, told = Store(folder=tmp_path), []
    for _ in range(2):
        with collecting() as entries:
            find_model(views, ReconstructConfig(), store)
        told.append([(entry.guard, entry.count, entry.total) for entry in left_out_of(entries)])
    assert told == [[("sfm.tracks", 1, 9)]] * 2


def test_a_folder_that_cannot_be_written_ends_nothing(views, runs, tmp_path):
    Path(tmp_path / "file").write_text("")
    with pytest.warns(PimperWarning, match="cannot be kept there"):
        model, _ = find_model(views, ReconstructConfig(), Store(folder=tmp_path / "file" / "new"))
    assert model.num_views == 5
