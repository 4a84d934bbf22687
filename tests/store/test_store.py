"""Records stored between runs."""

import os
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.records import Cameras, Record, StageReport
from pimper_torch.runtime.errors import OutputError
from pimper_torch.runtime.user_cache import user_cache
from pimper_torch.store import Store, digest, opened, realigned


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair(Record):
    one: Float[Tensor, "*shape"]
    other: Float[Tensor, "*shape"]


@pytest.fixture
def record():
    generator = torch.Generator().manual_seed(3)
    return Cameras(
        intrinsics=torch.eye(3).repeat(2, 1, 1),
        cam_from_world=torch.rand(2, 4, 4, generator=generator),
        sizes_px=torch.tensor([[80, 60]] * 2),
    )


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_stored_record_is_read_bit_for_bit(record, tmp_path):
    store = Store(folder=tmp_path / "new" / "folder")
    assert store.find("a", Cameras) is None
    assert store.keep("a", record, {"seconds": 12.5})
    found, about = store.find("a", Cameras)
    assert about == {"seconds": 12.5}
    assert digest(found) == digest(record)
    assert store.find("b", Cameras) is None
    assert store.find("a", StageReport) is None


@pytest.mark.parametrize("damage", ["cut short", "tensor", "about", "empty", "another file"])
def test_a_damaged_entry_is_never_used(record, tmp_path, damage):
    store, path = Store(folder=tmp_path), tmp_path / "a.safetensors"
    store.keep("a", record, {"seconds": 12.5})
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) - 20] ^= 1
    damaged = {
        "cut short": whole[:-1],
        "tensor": bytes(flipped),
        "about": whole.replace(b"12.5", b"12.6"),
        "empty": b"",
        "another file": b"PK" + bytes(100),
    }
    path.write_bytes(damaged[damage])
    assert store.find("a", Cameras) is None
    store.keep("a", record)
    assert store.find("a", Cameras) is not None


def test_a_partly_written_entry_is_not_found(record, tmp_path, monkeypatch):
    def full(self, target):
        raise OSError("disk full")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OutputError, match="disk full"):
        Store(folder=tmp_path).keep("a", record)
    assert files(tmp_path) == []


def test_the_least_recently_used_entries_are_removed(record, tmp_path):
    store = Store(folder=tmp_path)
    for second, key in enumerate("abc"):
        store.keep(key, record)
        os.utime(tmp_path / f"{key}.safetensors", (second, second))
    size = (tmp_path / "a.safetensors").stat().st_size
    assert store.find("a", Cameras)  # most recently used
    assert Store(folder=tmp_path, max_bytes=3 * size).keep("d", record)
    assert files(tmp_path) == [f"{key}.safetensors" for key in "acd"]
    assert not Store(folder=tmp_path, max_bytes=size - 1).keep("e", record)
    assert files(tmp_path) == []


def test_files_of_a_killed_run_are_deleted_after_a_day(record, tmp_path):
    old, new = tmp_path / ".a.safetensors.new-0a", tmp_path / ".a.safetensors.new-0b"
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (0, 0))
    Store(folder=tmp_path).keep("a", record)
    assert (old.exists(), new.exists()) == (False, True)


def test_fresh_ignores_and_replaces_entries(record, tmp_path):
    Store(folder=tmp_path).keep("a", record)
    afresh = Store(folder=tmp_path, fresh=True)
    assert afresh.find("a", Cameras) is None
    afresh.keep("a", record.replace(cam_from_world=record.cam_from_world + 1))
    assert not torch.equal(
        Store(folder=tmp_path).find("a", Cameras)[0].cam_from_world, record.cam_from_world
    )


def test_records_that_require_gradients_are_not_stored(record, tmp_path):
    store = Store(folder=tmp_path)
    assert not store.keep("a", record.replace(intrinsics=record.intrinsics.requires_grad_()))
    assert files(tmp_path) == []


def test_realigned_tensors_have_one_layout(record):
    shared = torch.rand(4, 4, 2).permute(2, 0, 1)
    whole = torch.rand(33)[1:].reshape(2, 4, 4)
    found = realigned(record.replace(cam_from_world=shared))
    assert torch.equal(found.cam_from_world, shared)
    assert found.cam_from_world.is_contiguous()
    assert found.intrinsics is record.intrinsics
    assert realigned(record.replace(cam_from_world=whole)).cam_from_world.data_ptr() % 64 == 0
    pair = Pair(one=shared, other=shared)
    both = realigned(pair)
    assert both.one is both.other


def test_a_folder_is_a_store(tmp_path):
    store = Store(folder=tmp_path)
    assert opened(store) is store
    assert opened(tmp_path) == store
    assert opened(None) is None


def test_the_users_cache_follows_xdg(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert user_cache() == tmp_path / "pimper_torch"
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for unset in ("", "relative/path"):
        monkeypatch.setenv("XDG_CACHE_HOME", unset)
        assert user_cache() == tmp_path / "home" / ".cache" / "pimper_torch"
