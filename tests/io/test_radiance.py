import time

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_torch.io import radiance
from pimper_torch.io.photographs import load_views
from pimper_torch.io.radiance import resized, resized_radiance
from pimper_torch.radiometry import LINEAR, SATURATED, Encoding
from pimper_torch.runtime.errors import InputError, PimperWarning


@pytest.fixture
def raw(tmp_path, write_png16):
    """Three 16-bit photographs of a sensor that saturates at 15000; their true levels."""
    generator = np.random.default_rng(6)
    folder = tmp_path / "raw"
    folder.mkdir()
    levels = 22_000 * generator.random((3, 60, 90, 3)) ** 3
    for index, one in enumerate(levels):
        write_png16(folder / f"{index}.png", one.clip(max=15_000).round().astype(np.uint16))
    return folder, torch.from_numpy(levels).movedim(-1, 1)


@pytest.mark.parametrize("saturation", [15000.0, 15000 / 65535, (15000, 15000, 15000), "auto"])
def test_saturation_below_full_scale_is_scaled_to_one(raw, saturation):
    folder, levels = raw
    encoding = Encoding(response="linear", saturation=saturation)
    if saturation == "auto":
        with pytest.warns(PimperWarning, match="16-bit files pile up at 15000 of 65535"):
            images = load_views(folder, encoding=encoding).images
    else:
        images = load_views(folder, encoding=encoding).images
    assert_close(images.double(), (levels / 15000).clamp(max=1), rtol=0, atol=1e-4)  # rounding
    assert torch.equal(images >= SATURATED, levels.round() >= SATURATED * 15000)


def test_full_scale_can_be_forced(raw):
    folder, _ = raw
    assert float(load_views(folder, encoding=LINEAR).images.max()) == pytest.approx(15000 / 65535)


def test_channels_saturate_at_different_levels(raw, write_png16):
    folder, levels = raw
    white = torch.tensor([15000, 12000, 9000]).double()[:, None, None]
    for index, one in enumerate(levels):
        array = torch.minimum(one, white).round().movedim(0, -1).numpy().astype(np.uint16)
        write_png16(folder / f"{index}.png", array)
    wanted = (levels / white).clamp(max=1)
    stated = Encoding(response="linear", saturation=(15000, 12000, 9000))
    assert_close(load_views(folder, encoding=stated).images.double(), wanted, rtol=0, atol=1e-4)
    with pytest.warns(PimperWarning, match=r"15000, 12000, 9000 \(red, green, blue\)"):
        found = load_views(folder, encoding=Encoding(response="linear")).images
    assert_close(found.double(), wanted, rtol=0, atol=1e-4)


def test_a_channel_without_saturation_is_scaled_like_the_others(raw, write_png16):
    folder, levels = raw
    for index, one in enumerate(levels):
        array = one.clamp(max=15000).round()
        array[2] = one[2].clamp(max=14000) / 3  # no pixels pile up at a level in blue
        array[2] = array[2] * torch.rand(60, 90, generator=torch.Generator().manual_seed(index))
        write_png16(folder / f"{index}.png", array.movedim(0, -1).numpy().astype(np.uint16))
    with pytest.warns(PimperWarning, match="pile up at 15000 of 65535"):
        images = load_views(folder, encoding=Encoding(response="linear")).images
    assert images[:, 0].max() == 1
    assert 0.2 < images[:, 2].max() < 1 / 3


def test_black_becomes_zero(raw):
    folder, levels = raw
    encoding = Encoding(response="linear", saturation=15000.0, black=512.0)
    wanted = ((levels - 512) / (15000 - 512)).clamp(0, 1)
    found = load_views(folder, encoding=encoding).images
    assert_close(found.double(), wanted, rtol=0, atol=1e-4)


def test_the_saturation_level_is_given_in_file_levels(photos, pixels):
    found = load_views(photos, encoding=Encoding(response=2.0, saturation=200.0)).images
    stored = torch.from_numpy(pixels / 255).movedim(-1, 0)
    wanted = (stored**2 / (200 / 255) ** 2).clamp(max=1)
    assert_close(found[0].double(), wanted, rtol=0, atol=1e-6)


def test_a_curve_is_applied_only_to_files_of_its_depth(photos, pixels, raw, tmp_path):
    levels = np.arange(256.0)
    np.save(tmp_path / "a.npy", levels**1.5)
    encoding = Encoding(response=tmp_path / "a.npy")
    stored = torch.from_numpy(pixels / 255).movedim(-1, 0)
    found = load_views(photos, encoding=encoding).images[0]
    assert_close(found.double(), stored**1.5, rtol=0, atol=1e-6)
    message = r"0\.png: has 16 bits, levels 0 to 65535, but the response curve ends at level 255"
    with pytest.raises(InputError, match=message):
        load_views(raw[0], encoding=encoding)


def test_a_curve_of_three_colours_or_levels_is_refused_for_gray_files(photos, pixels, tmp_path):
    np.save(tmp_path / "a.npy", np.arange(256.0)[:, None].repeat(3, axis=1))
    for path in photos.iterdir():
        Image.fromarray(pixels[..., 0]).save(path)
    with pytest.raises(InputError, match=r"1\.png: is gray, but the response curve"):
        load_views(photos, encoding=Encoding(response=tmp_path / "a.npy"))
    with pytest.raises(InputError, match=r"1\.png: is gray, but saturation has levels"):
        load_views(photos, encoding=Encoding(saturation=(200, 200, 200)))


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"saturation": 15000.0}, r"1\.png: has 8 bits, levels 0 to 255, but a level of"),
        ({"black": 512.0}, r"1\.png: has 8 bits, levels 0 to 255, but a level of"),
        (
            {"saturation": 0.5, "black": 200.0},
            r"black is 0\.7843 of full scale and saturation 0\.5",
        ),
    ],
)
def test_levels_outside_the_range_of_the_files_are_refused(photos, settings, why):
    with pytest.raises(InputError, match=why):
        load_views(photos, encoding=Encoding(**settings))


@pytest.mark.parametrize("size", [(13, 9), (20, 20), (39, 10)])
def test_a_resized_pixel_with_a_saturated_source_is_saturated(size):
    torch.manual_seed(7)
    radiance = 0.5 * torch.rand(2, 30, 40, dtype=torch.float64)
    radiance[0, 11, 17] = 1.0
    width, height = size
    found, plain = resized_radiance(radiance, width, height), resized(radiance, width, height)
    lifted = radiance.clone()
    lifted[0, 11, 17] = 2.0
    touched = resized(lifted, width, height) - plain > 1e-3  # pixels to which it contributes
    assert 1 <= int(touched.sum()) <= 9
    assert torch.equal(found >= SATURATED, touched)  # in both channels
    assert torch.equal(found[~touched], plain[~touched])
    assert plain.max() < 0.9  # levels alone do not reveal it


def test_saturation_is_found_before_shrinking(raw, write_png16):
    folder, levels = raw
    large = levels.clamp(max=15000).repeat_interleave(6, dim=-1).repeat_interleave(6, dim=-2)
    for index, one in enumerate(large):
        write_png16(folder / f"{index}.png", one.movedim(0, -1).numpy().round().astype(np.uint16))
    with pytest.warns(PimperWarning, match="pile up at 15000"):
        found = load_views(folder, encoding=Encoding(response="linear"), max_size_px=180).images
    touched = torch.nn.functional.max_pool2d((large >= 15000).double(), 3) > 0
    assert (found >= SATURATED)[touched].all()
    assert (found < SATURATED).float().mean() > 0.3


def test_fully_saturated_photographs_are_refused_and_nearly_so_give_a_warning(photos, pixels):
    array = np.full_like(pixels, 255)
    Image.fromarray(array).save(photos / "2.png")
    with pytest.raises(
        InputError, match=r"2\.png is completely saturated.*photographs\.saturation"
    ):
        load_views(photos)
    array[0, :5] = 40, 30, 20
    Image.fromarray(array).save(photos / "2.png")
    with pytest.warns(PimperWarning, match=r"nearly all .* saturated in 2\.png \(5\.2% usable\)"):
        views = load_views(photos)
    assert views.num_views == 3


def test_saturation_off_the_object_does_not_matter(photos, pixels, tmp_path):
    (tmp_path / "masks").mkdir()
    array = np.full_like(pixels, 255)
    array[2:4, 3:5] = 90, 80, 70
    drawn = np.zeros((8, 12), dtype=np.uint8)
    drawn[2:4, 3:5] = 255
    Image.fromarray(array).save(photos / "2.png")
    for name in ("1", "2", "10"):
        Image.fromarray(drawn).save(tmp_path / "masks" / f"{name}.png")
    assert load_views(photos, masks=tmp_path / "masks").num_views == 3


def test_files_of_different_depths_have_separate_saturation_levels(raw, pixels):
    folder, levels = raw
    generator = np.random.default_rng(8)
    shallow = (255 * generator.random((60, 90, 3)) ** 3).round().astype(np.uint8)
    Image.fromarray(shallow).save(folder / "8.png")
    with pytest.warns(PimperWarning, match="16-bit files pile up at 15000"):
        images = load_views(folder, encoding=Encoding(response="linear")).images
    assert_close(images[3], torch.from_numpy(shallow / 255).movedim(-1, 0).float())
    assert_close(images[0].double(), (levels[0] / 15000).clamp(max=1), rtol=0, atol=1e-4)


@pytest.mark.parametrize(("suffix", "at_once"), [("png", 1), ("jpg", 2)])
def test_files_that_are_shrunk_after_decoding_are_in_memory_one_at_a_time(
    tmp_path, monkeypatch, suffix, at_once
):
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    for index in range(6):
        Image.fromarray(pixels).save(tmp_path / f"{index}.{suffix}")
    together, most = 0, 0

    def decode(*given):
        nonlocal together, most
        together += 1
        most = max(most, together)
        time.sleep(0.02)
        found = original(*given)
        together -= 1
        return found

    original = radiance.decode
    monkeypatch.setattr(radiance, "decode", decode)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    load_views(tmp_path, max_size_px=32)
    assert most <= at_once
    assert suffix == "png" or most == at_once
