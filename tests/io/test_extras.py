"""HEIC and camera raw, which need extras: missing, damaged, huge or misnamed files."""

import importlib.util

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_torch.io.decode import decode, read_header
from pimper_torch.io.photographs import load_views
from pimper_torch.runtime.errors import InputError, PimperWarning
from tests.io.dng import write_dng
from tests.io.heic_files import DEEP, STORED

KINDS = {".heic": ("heic", "a HEIC image", "heif"), ".dng": ("raw", "camera raw", "rawpy")}


def write(path, **options):
    if path.suffix == ".dng":
        write_dng(path, np.random.default_rng(0).integers(256, 4000, (40, 60)), **options)
    else:
        path.write_bytes(DEEP)
    return path


@pytest.mark.parametrize("suffix", KINDS)
def test_without_its_package_a_format_is_refused(tmp_path, monkeypatch, pixels, suffix):
    extra, kind, package = KINDS[suffix]
    for index in range(3):
        write(tmp_path / f"{index}{suffix}")
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "pimper_torch.io.extras.find_spec",
        lambda name: None if name.endswith(package) else find(name),
    )
    for read in (load_views, lambda folder: read_header(folder / f"0{suffix}")):
        told = rf'0\{suffix}: is {kind}, which needs an .*pip install "pimper_torch\[{extra}\]"'
        with pytest.raises(InputError, match=told):
            read(tmp_path)
    for index in range(3):  # among other photographs it is skipped with a warning
        Image.fromarray(pixels).save(tmp_path / f"{index}.jpg")
    message = rf'were not read: .* \(3\).* `pip install "pimper_torch\[{extra}\]"` reads {extra}\.'
    with pytest.warns(PimperWarning, match=message):
        assert load_views(tmp_path).names == ("0.jpg", "1.jpg", "2.jpg")


@pytest.mark.parametrize("suffix", KINDS)
def test_damaged_and_huge_files_are_refused_by_name(tmp_path, monkeypatch, suffix):
    pytest.importorskip({".dng": "rawpy", ".heic": "pi_heif"}[suffix])
    path = write(tmp_path / f"a{suffix}")
    whole = path.read_bytes()
    for fraction in (0, 0.001, 0.02, 0.3, 0.5, 0.9):
        (tmp_path / f"cut{suffix}").write_bytes(whole[: int(fraction * len(whole))])
        with pytest.raises(InputError, match=rf"cut\{suffix}"):
            decode(tmp_path / f"cut{suffix}")
    if suffix == ".dng":  # larger than its data
        write(tmp_path / "huge.dng", size=(30000, 20000))
        with pytest.raises(InputError, match=r"huge\.dng: cannot be read as camera raw"):
            decode(tmp_path / "huge.dng")
    monkeypatch.setattr("pimper_torch.io.decode.MAX_PIXELS", 1000)
    with pytest.raises(InputError, match=rf"a\{suffix}: has (60 x 40|64 x 48) pixels"):
        decode(path)
    with pytest.raises(InputError, match=rf"gone\{suffix}: cannot be read \(No such file"):
        read_header(tmp_path / f"gone{suffix}")


@pytest.mark.parametrize(
    ("suffix", "name", "lossy"),
    [(".heic", "TIFF", False), (".cr2", "JPEG", True), (".png", "JPEG", True)],
)
def test_images_are_read_with_any_suffix(tmp_path, monkeypatch, suffix, name, lossy):
    monkeypatch.setattr("pimper_torch.io.extras.find_spec", lambda _: None)  # not needed
    for index in range(3):
        Image.fromarray(STORED).save(tmp_path / f"{index}{suffix}", format=name)
    decoded = decode(tmp_path / f"0{suffix}")
    wanted = torch.from_numpy(STORED / 255).movedim(-1, 0).float()
    assert_close(decoded.samples, wanted, rtol=0, atol=7 / 255 if lossy else 0)
    assert decoded.lossy == lossy
    assert load_views(tmp_path).num_views == 3


@pytest.mark.parametrize(
    ("start", "name"),
    [
        (b"\0\0\0\x20ftypavif\0\0\0\0", "AVIF"),
        (b"RIFF\x10\0\0\0WEBPVP8 ", "WebP"),
        (b"\0\0\0\x20ftypisom\0\0\0\0", "MP4"),
        (b"%PDF-1.7" + bytes(20), "PDF"),
    ],
)
@pytest.mark.parametrize("suffix", [".heic", ".dng"])
def test_a_refusal_names_the_actual_format_of_a_file(tmp_path, start, name, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(start)
    with pytest.raises(InputError, match=rf"a\{suffix}: is not a readable JPEG.*, but {name}\."):
        read_header(path)
