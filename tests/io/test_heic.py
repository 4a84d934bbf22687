import importlib.util

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_torch.io.decode import decode, read_header
from pimper_torch.io.photographs import load_views
from pimper_torch.radiometry import Srgb
from pimper_torch.runtime.errors import PimperWarning
from tests.io.heic_files import DEEP, STORED, UPRIGHT

# The format is lossy: one to three levels of 255.
LOSS = 3.5 / 255


@pytest.fixture(autouse=True)
def needs_heif():
    if not any(importlib.util.find_spec(name) for name in ("pi_heif", "pillow_heif")):
        pytest.skip("needs pi_heif or pillow_heif")


def write(path, data):
    path.write_bytes(data)
    return path


def test_heic_is_rotated_once_and_has_its_focal_length_and_profile(tmp_path):
    path = write(tmp_path / "a.HEIC", UPRIGHT)
    header = read_header(path)
    assert (header.width, header.height, header.orientation) == (48, 64, 1)
    assert header.focal_px == pytest.approx(50 * np.hypot(48, 64) / np.hypot(36, 24))
    assert header.colour.source == 'the ICC profile "Display P3"'
    assert header.colour.response == Srgb()
    assert header.colour.srgb_from_file is not None
    decoded = decode(path)
    wanted = torch.from_numpy(np.rot90(STORED, -1).copy() / 255).movedim(-1, 0).float()
    assert_close(decoded.samples, wanted, rtol=0, atol=LOSS)
    assert (decoded.lossy, decoded.full, decoded.alpha) == (True, 255, None)


def test_ten_bit_heic_keeps_its_depth(tmp_path):
    decoded = decode(write(tmp_path / "a.heif", DEEP))
    assert decoded.full == 1023 << 6
    wanted = torch.from_numpy(STORED / 255).movedim(-1, 0).float()
    assert_close(decoded.samples, wanted, rtol=0, atol=LOSS)
    assert len((decoded.samples * 1023).round().unique()) > 200


def test_heic_with_a_jpeg_of_the_same_name_is_skipped(tmp_path):
    for index in range(3):
        write(tmp_path / f"{index}.heic", DEEP)
        Image.fromarray(STORED).save(tmp_path / f"{index}.jpg")
    with pytest.warns(PimperWarning, match=r"were not read: HEIC \(3\)"):
        assert load_views(tmp_path).names == ("0.jpg", "1.jpg", "2.jpg")


@pytest.mark.parametrize("suffix", [".PNG", ".dng"])
def test_heic_is_read_with_any_suffix(tmp_path, suffix):
    wanted = decode(write(tmp_path / "a.heic", DEEP))
    found = decode(write(tmp_path / f"b{suffix}", DEEP))
    assert torch.equal(found.samples, wanted.samples)
    assert (found.lossy, found.full) == (True, wanted.full)
