import errno
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import torch
from PIL import Image

from pimper_torch.geometry.pyramids import build_pyramids
from pimper_torch.geometry.undistortion import undistort
from pimper_torch.io.photographs import load_views
from pimper_torch.records import CameraModel, Silhouettes
from pimper_torch.runtime import mapped
from pimper_torch.runtime.errors import OutputError
from pimper_torch.runtime.memory import resident_bytes
from pimper_torch.store import digest, realigned

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells")


@pytest.fixture
def small(monkeypatch, tmp_path):
    """Map every tensor that is not empty, to the test's folder."""
    monkeypatch.setattr(mapped, "LARGE", 1)
    monkeypatch.setattr(mapped, "_in_memory", lambda folder: False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


@pytest.fixture
def photos(tmp_path):
    generator = torch.Generator().manual_seed(3)
    for kind, channels in (("photos", 3), ("masks", 1)):
        (tmp_path / kind).mkdir()
        for view in range(4):
            pixels = torch.randint(0, 256, (20, 30, channels), generator=generator).byte().numpy()
            picture = Image.fromarray(pixels[..., 0] if channels == 1 else pixels)
            picture.save(tmp_path / kind / f"{view}.png")
    return tmp_path / "photos"


def is_mapped(tensor):
    start = tensor.untyped_storage().data_ptr()
    return any(
        torch.frombuffer(one, dtype=torch.uint8).data_ptr() == start for one in mapped._mapped
    )


def test_mapped_tensors_keep_their_values_after_references_are_dropped(small):
    tensor = mapped.zeros((3, 5), torch.float64)
    assert is_mapped(tensor)
    assert not bool(tensor.any())
    tensor.copy_(torch.arange(15.0).reshape(3, 5))
    mapped.drop_pages()
    assert torch.equal(tensor, torch.arange(15.0).reshape(3, 5).double())
    assert [float(one.sum()) for (one,) in mapped.each(tensor)] == [10, 35, 60]


def test_photographs_on_disk_have_the_bits_of_those_in_memory(photos, request):
    plain = load_views(photos, masks=photos.with_name("masks"))
    request.getfixturevalue("small")
    found = load_views(photos, masks=photos.with_name("masks"))
    assert is_mapped(found.images)
    assert is_mapped(found.masks)
    assert torch.equal(plain.images, found.images)
    assert torch.equal(plain.masks, found.masks)


def test_mapped_files_are_removed_and_their_space_is_freed(small, tmp_path):
    tensor = mapped.zeros((1000,))
    assert not list(tmp_path.iterdir())
    assert len(mapped._mapped) >= 1
    before = len(mapped._mapped)
    del tensor
    assert len(mapped._mapped) == before - 1


@LINUX
def test_no_file_remains_after_a_kill(tmp_path):
    code = (
        "import os, signal; from pimper_torch.runtime import mapped; mapped.LARGE = 1;"
        "mapped._in_memory = lambda folder: False; held = mapped.zeros((1000,)); held += 1;"
        "print(len(mapped._mapped), flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    run = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "TMPDIR": str(tmp_path)},
        capture_output=True,
        check=False,
    )
    assert (run.returncode, run.stdout) == (-9, b"1\n"), run.stderr
    assert not list(tmp_path.iterdir())


@LINUX
def test_pages_on_disk_are_not_counted_as_memory(monkeypatch):
    monkeypatch.setattr(mapped, "_in_memory", lambda folder: False)
    monkeypatch.setattr(mapped, "LARGE", 1)
    before = resident_bytes()
    tensor = mapped.zeros((100, 250_000)).fill_(1.0)
    assert resident_bytes() - before < 2e7
    assert float(tensor.sum()) == 2.5e7


def test_a_full_disk_is_reported_before_writing(small, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    with pytest.raises(OutputError, match=r"no space for 4\.0 GB .* TMPDIR to a"):
        mapped.zeros((1000, 1_000_000))


def test_files_go_to_disk_if_the_temporary_folder_is_in_memory(small, monkeypatch, tmp_path):
    monkeypatch.setattr(mapped, "_in_memory", lambda folder: folder == str(tmp_path))
    assert mapped._folder() == "/var/tmp"
    monkeypatch.setattr(mapped, "_in_memory", lambda folder: True)
    assert mapped._folder() is None
    assert not is_mapped(mapped.zeros((5,)))


@LINUX
def test_folders_in_memory_are_recognised_by_their_mount():
    mounts = [line.split() for line in Path("/proc/mounts").read_text().splitlines()]
    kinds = {point: kind for _, point, kind, *_ in mounts}
    inside = [point for point, kind in kinds.items() if kind == "tmpfs"]
    if not inside:
        pytest.skip("no folder is in memory here")
    assert all(map(mapped._in_memory, inside))
    assert not mapped._in_memory("/proc")


def test_slices_copies_and_selections_equal_those_in_memory(request):
    tensor = torch.arange(60.0).reshape(5, 12)
    picked = torch.tensor([4, 0, 0]), torch.tensor([True, False, True, False, True])
    plain = [tensor[index] for index in picked]
    request.getfixturevalue("small")
    found = [mapped.take_rows(tensor, index) for index in picked]
    assert all(map(torch.equal, plain, found))
    assert all(map(is_mapped, found))
    assert torch.equal(mapped.copied(tensor.T), tensor.T)
    assert torch.equal(mapped.copied(torch.tensor(3)), torch.tensor(3))
    first, second = mapped.parts([(2, 3), (4,)])
    second.fill_(1)
    assert not bool(first.any())
    assert (first.shape, second.shape) == ((2, 3), (4,))


def test_a_copy_to_disk_keeps_its_gradient(small):
    values = torch.ones(3, requires_grad=True)
    mapped.copied(values).square().sum().backward()
    assert values.grad is not None
    assert values.grad.tolist() == [2, 2, 2]


def chain_of(photos):
    """Load and undistort photographs, use masks as silhouettes and build pyramids."""
    views = load_views(photos, masks=photos.with_name("masks"))
    params = (30.0, 15.0, 10.0, -0.1)
    lens = CameraModel(camera=1, model="SIMPLE_RADIAL", params=params, width=30, height=20)
    views, _ = undistort(views.take([2, 0, 3]), (lens, lens, lens))
    inside = mapped.by_view(torch.Tensor.float, views.masks)
    found = Silhouettes(inside=inside, reliable=torch.ones(3, dtype=torch.bool), source="masks")
    sources = build_pyramids(views.replace(masks=found.masks & views.inside))
    pyramids = sources.images, sources.gray, sources.unusable
    arrays = [one for pyramid in pyramids for one in (pyramid.finest, pyramid.coarser)]
    return [*arrays, views.masks, realigned(found).inside], digest(sources)


def test_stages_give_the_same_bits_from_photographs_on_disk(photos, request):
    plain, hashed = chain_of(photos)
    request.getfixturevalue("small")
    found, again = chain_of(photos)
    assert all(map(torch.equal, plain, found))
    assert all(map(is_mapped, found))
    assert again == hashed


def test_small_tensors_and_those_of_other_devices_stay_in_memory():
    assert not is_mapped(mapped.zeros((3, 5)))
    assert mapped.zeros((mapped.LARGE,), torch.uint8, "meta").is_meta


def test_an_unwritable_or_missing_folder_is_skipped(small, monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    assert mapped._folder() == "/var/tmp"
