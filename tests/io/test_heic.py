import base64
import importlib.util

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_torch.doors.io.decode import decode, read_header
from pimper_torch.doors.io.photographs import load_views
from pimper_torch.ground.radiometry import Srgb, linear_from_srgb
from pimper_torch.runtime.errors import InputError, PimperWarning
from tests.io.heic_files import DEEP, UPRIGHT

# Of a lossy format: a level or three of 255.
LOSS = 3.5 / 255


@pytest.fixture(autouse=True)
def needs_heif():
    if not any(importlib.util.find_spec(name) for name in ("pi_heif", "pillow_heif")):
        pytest.skip("needs pi_heif or pillow_heif")


@pytest.fixture
def stored():
    """The picture of both files before any rotation."""
    v, u = np.mgrid[:48, :64]
    return np.stack([40 + 3 * u, 60 + 3 * v, 60 + u + v], axis=-1).astype(np.uint8)


def write(path, text):
    path.write_bytes(base64.b64decode(text))
    return path


def test_heic_is_turned_once_and_has_its_focal_length_and_profile(tmp_path, stored):
    path = write(tmp_path / "a.HEIC", UPRIGHT)
    header = read_header(path)
    assert (header.width, header.height, header.orientation) == (48, 64, 1)
    assert header.focal_px == pytest.approx(50 * np.hypot(48, 64) / np.hypot(36, 24))
    assert header.colour.source == 'the ICC profile "Display P3"'
    assert header.colour.response == Srgb()
    assert header.colour.srgb_from_file is not None
    decoded = decode(path)
    wanted = torch.from_numpy(np.rot90(stored, -1).copy() / 255).movedim(-1, 0).float()
    assert_close(decoded.samples, wanted, rtol=0, atol=LOSS)
    assert (decoded.lossy, decoded.full, decoded.alpha) == (True, 255, None)


def test_heic_of_ten_bits_keeps_them(tmp_path, stored):
    decoded = decode(write(tmp_path / "a.heif", DEEP))
    assert decoded.full == 1023 << 6
    wanted = torch.from_numpy(stored / 255).movedim(-1, 0).float()
    assert_close(decoded.samples, wanted, rtol=0, atol=LOSS)
    assert len((decoded.samples * 1023).round().unique()) > 200


def test_heic_and_png_are_one_set(tmp_path, stored):
    for index in range(2):
        write(tmp_path / f"{index}.heic", DEEP)
    Image.fromarray(stored).save(tmp_path / "2.png")
    images = load_views(tmp_path).images
    wanted = linear_from_srgb(torch.from_numpy(stored / 255).movedim(-1, 0)).float()
    assert_close(images, wanted.expand(3, -1, -1, -1), rtol=0, atol=2.4 * LOSS)


def test_heic_beside_a_jpeg_of_the_same_name_is_passed_over(tmp_path, stored):
    for index in range(3):
        write(tmp_path / f"{index}.heic", DEEP)
        Image.fromarray(stored).save(tmp_path / f"{index}.jpg")
    with pytest.warns(PimperWarning, match=r"were not read: HEIC \(3\)"):
        assert load_views(tmp_path).names == ("0.jpg", "1.jpg", "2.jpg")


def test_without_its_package_heic_is_refused_with_what_to_install(tmp_path, monkeypatch):
    for index in range(3):
        write(tmp_path / f"{index}.heic", DEEP)
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "pimper_torch.doors.io.extras.find_spec",
        lambda name: None if name.endswith("heif") else find(name),
    )
    told = r'0\.heic: is a HEIC image, which needs one more package: .*"pimper_torch\[heic\]"'
    with pytest.raises(InputError, match=told):
        load_views(tmp_path)


@pytest.mark.parametrize("suffix", [".PNG", ".dng"])
def test_heic_is_read_whatever_it_is_called(tmp_path, suffix):
    wanted = decode(write(tmp_path / "a.heic", DEEP))
    found = decode(write(tmp_path / f"b{suffix}", DEEP))
    assert torch.equal(found.samples, wanted.samples)
    assert (found.lossy, found.full) == (True, wanted.full)


@pytest.mark.parametrize(
    ("suffix", "name", "lossy"),
    [(".heic", "TIFF", False), (".cr2", "JPEG", True), (".png", "JPEG", True)],
)
def test_other_images_are_read_whatever_they_are_called(
    tmp_path, stored, monkeypatch, suffix, name, lossy
):
    monkeypatch.setattr("pimper_torch.doors.io.extras.find_spec", lambda _: None)  # none is needed
    for index in range(3):
        Image.fromarray(stored).save(tmp_path / f"{index}{suffix}", format=name)
    decoded = decode(tmp_path / f"0{suffix}")
    wanted = torch.from_numpy(stored / 255).movedim(-1, 0).float()
    assert_close(decoded.samples, wanted, rtol=0, atol=2 * LOSS if lossy else 0)
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
def test_what_a_file_of_another_format_is_stands_in_its_refusal(tmp_path, start, name, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(start)
    with pytest.raises(InputError, match=rf"a\{suffix}: holds no JPEG.*, but {name}\."):
        read_header(path)


def test_damaged_and_huge_heic_is_refused_by_name(tmp_path, monkeypatch):
    path = write(tmp_path / "a.heic", UPRIGHT)
    whole = path.read_bytes()
    for fraction in (0, 0.02, 0.5, 0.9):
        (tmp_path / "cut.heic").write_bytes(whole[: int(fraction * len(whole))])
        with pytest.raises(InputError, match=r"cut\.heic"):
            decode(tmp_path / "cut.heic")
    monkeypatch.setattr("pimper_torch.doors.io.decode.MAX_PIXELS", 1000)
    with pytest.raises(InputError, match=r"a\.heic: has 48 x 64 pixels"):
        decode(path)
    with pytest.raises(InputError, match=r"b\.heic: cannot be read \(No such file"):
        read_header(tmp_path / "b.heic")
