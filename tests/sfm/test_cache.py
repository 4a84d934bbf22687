"""Models that are kept from run to run."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pimper_torch.errors import OutputError
from pimper_torch.sfm import cache as caching
from pimper_torch.sfm import reconstruct
from pimper_torch.sfm.cache import KeptModel, ModelCache, model_key, user_cache
from pimper_torch.sfm.reconstruct import Reconstruct, ReconstructConfig


@pytest.fixture
def kept(model):
    maps = torch.eye(3, dtype=torch.float64).repeat(5, 1, 1)
    return KeptModel(model=model.replace(background_from_view=maps), seconds=12.5)


def entry(folder: Path) -> Path:
    (only,) = folder.iterdir()
    return only


def test_a_model_comes_back_bit_for_bit(kept, tmp_path):
    cache = ModelCache(folder=tmp_path / "new" / "cache")
    assert cache.find("a") is None
    cache.keep("a", kept)
    found = cache.find("a")
    assert found.seconds == 12.5
    assert (found.model.names, found.model.lenses) == (kept.model.names, kept.model.lenses)
    for name in ("cam_from_world", "points_world", "observation_pixels", "background_from_view"):
        assert torch.equal(getattr(found.model, name), getattr(kept.model, name))
        assert getattr(found.model, name).dtype == torch.float64
    for name in ("observation_point", "observation_view"):
        assert torch.equal(getattr(found.model, name), getattr(kept.model, name))
    assert cache.find("b") is None


@pytest.mark.parametrize("damage", ["cut short", "a bit", "empty", "another file"])
def test_a_damaged_entry_is_never_believed(kept, tmp_path, damage):
    cache = ModelCache(folder=tmp_path)
    cache.keep("a", kept)
    whole = entry(tmp_path).read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    damaged = {
        "cut short": whole[:-1],
        "a bit": bytes(flipped),
        "empty": b"",
        "another file": b"PK" + bytes(100),
    }
    entry(tmp_path).write_bytes(damaged[damage])
    assert cache.find("a") is None
    cache.keep("a", kept)
    assert cache.find("a") is not None


def test_a_model_that_was_not_written_whole_is_not_there(kept, tmp_path, monkeypatch):
    cache = ModelCache(folder=tmp_path)

    def fail(self, target):
        raise OSError("disk full")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OutputError, match="disk full"):
        cache.keep("a", kept)
    assert cache.find("a") is None
    assert list(tmp_path.iterdir()) == []


def test_all_that_a_model_depends_on_makes_another_key(views, monkeypatch):
    config = ReconstructConfig()
    brighter = views.images.clone()
    brighter[4, 2, 59, 79] += 1e-9
    keys = {
        model_key(views, config),
        model_key(views.replace(images=brighter), config),
        model_key(views.replace(names=("z.jpg", *views.names[1:])), config),
        model_key(views.replace(masks=views.inside), config),
        model_key(views.replace(masks=~views.inside), config),
        model_key(views.replace(focals_px=torch.full((5,), 90.0, dtype=torch.float64)), config),
        model_key(views.replace(sizes_px=views.sizes_px - 1), config),
        model_key(views, replace(config, seed=1)),
    }
    monkeypatch.setattr(caching, "_code", lambda: {"rooms": "other"})
    keys.add(model_key(views, config))
    assert len(keys) == 9
    assert model_key(views, config) == model_key(views.replace(images=views.images.clone()), config)


def test_structure_from_motion_runs_once_for_the_same_photographs(
    views, model, tmp_path, monkeypatch
):
    runs = []

    def found(given, config):
        runs.append(config)
        return model

    monkeypatch.setattr(reconstruct, "structure_from_motion", found)
    first = Reconstruct(cache=tmp_path)(views)
    second = Reconstruct(ReconstructConfig(threads=1), cache=str(tmp_path))(views)
    assert len(runs) == 1
    assert torch.equal(first.points_world, second.points_world)
    assert torch.equal(first.views.images, second.views.images)
    Reconstruct(ReconstructConfig(seed=1), cache=tmp_path)(views)
    Reconstruct()(views)
    assert len(runs) == 3


def test_the_users_cache_follows_xdg(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert user_cache() == tmp_path / "pimper_torch"
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for unset in ("", "relative/path"):
        monkeypatch.setenv("XDG_CACHE_HOME", unset)
        assert user_cache() == tmp_path / "home" / ".cache" / "pimper_torch"
