import struct
import zlib

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_torch.doors.io.decode import decode, read_header
from pimper_torch.doors.io.photographs import load_views
from pimper_torch.ground.radiometry import LINEAR, Encoding
from pimper_torch.runtime.errors import InputError, PimperWarning


@pytest.fixture
def both(tmp_path, pixels):
    """Write a TIFF of 8 bits and the same of 16, and read both."""

    def read(array, **options):
        found = []
        for name, one in (("8", array), ("16", array.astype(np.uint16) * 257)):
            tifffile.imwrite(tmp_path / f"{name}.tif", one, **options)
            found.append(decode(tmp_path / f"{name}.tif"))
        return found

    return read


def planes(array):
    values = torch.from_numpy(array / 255).float()
    return values[None] if values.ndim == 2 else values.movedim(-1, 0)


def test_white_is_zero_is_turned_round_at_either_depth(both, pixels):
    for decoded in both(255 - pixels[..., 0], photometric="miniswhite"):
        assert_close(decoded.samples, planes(pixels[..., 0]), rtol=0, atol=1e-6)


def test_colour_ramps_agree_at_either_depth(both, pixels):
    for options in ({}, {"planarconfig": "separate"}):
        array = np.moveaxis(pixels, -1, 0) if options else pixels
        for decoded in both(array, photometric="rgb", **options):
            assert_close(decoded.samples, planes(pixels), rtol=0, atol=1e-6)
            assert decoded.alpha is None


def test_ink_becomes_colour_at_either_depth(both, pixels, tmp_path):
    ink = np.concatenate([pixels, pixels[..., :1] // 2], axis=2)
    light = 1 - torch.from_numpy(ink / 255).movedim(-1, 0)
    wanted = (light[:3] * light[3:]).float()
    for decoded in both(ink, photometric="separated"):
        assert_close(decoded.samples, wanted, rtol=0, atol=0.003)  # of 8 bits
    assert "is CMYK" in read_header(tmp_path / "16.tif").cautions[0]


def test_samples_of_unknown_meaning_are_left_out_with_a_word(both, pixels, tmp_path):
    four = np.concatenate([pixels, pixels[..., :1]], axis=2)
    for decoded in both(four, photometric="rgb", extrasamples=["unspecified"]):
        assert_close(decoded.samples, planes(pixels), rtol=0, atol=1e-6)
        assert decoded.alpha is None
    for index in range(3):
        path = tmp_path / "photos" / f"{index}.tif"
        path.parent.mkdir(exist_ok=True)
        tifffile.imwrite(path, four, photometric="rgb", extrasamples=["unspecified"])
    told = r"3 of 3 .* has samples besides its colours whose meaning it does not tell"
    with pytest.warns(PimperWarning, match=told):
        assert load_views(tmp_path / "photos").masks is None


def test_colours_multiplied_by_their_opacity_are_divided_again(both, pixels):
    opacity = np.full((8, 12, 1), 128, dtype=np.uint8)
    opacity[2:4] = 255
    opacity[5] = 0
    array = np.concatenate([(pixels.astype(int) * opacity // 255).astype(np.uint8), opacity], 2)
    for decoded in both(array, photometric="rgb", extrasamples=["assocalpha"]):
        assert_close(decoded.alpha, planes(opacity)[0], rtol=0, atol=1e-6)
        seen = decoded.alpha > 0
        wanted = planes(pixels)
        assert_close(decoded.samples[:, seen], wanted[:, seen], rtol=0, atol=0.013)  # 3 levels
    for decoded in both(array, photometric="rgb", extrasamples=["unassalpha"]):
        assert_close(decoded.samples, planes(array[..., :3]), rtol=0, atol=1e-6)


def test_gray_multiplied_by_its_opacity_is_divided_again(tmp_path, pixels):
    opacity = np.full((8, 12), 128, dtype=np.uint8)
    array = np.stack([pixels[..., 0] // 2, opacity], axis=2)
    tifffile.imwrite(
        tmp_path / "a.tif", array, photometric="minisblack", extrasamples=["assocalpha"]
    )
    decoded = decode(tmp_path / "a.tif")
    assert_close(decoded.samples, planes(pixels[..., 0]), rtol=0, atol=0.013)  # 3 levels
    assert_close(decoded.alpha, planes(opacity)[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_the_picture_is_the_largest_page_that_is_no_small_copy(tmp_path, pixels, kind):
    factor = 1 if kind == np.uint8 else 257
    large, small = pixels.astype(kind) * factor, pixels[:4, :6].astype(kind) * factor
    wanted = planes(pixels)
    with tifffile.TiffWriter(tmp_path / "first.tif") as file:
        file.write(small, photometric="rgb", subfiletype=1)
        file.write(large, photometric="rgb")
    with tifffile.TiffWriter(tmp_path / "last.tif") as file:
        file.write(large, photometric="rgb")
        file.write(small, photometric="rgb", subfiletype=1)
    with tifffile.TiffWriter(tmp_path / "unmarked.tif") as file:
        file.write(small, photometric="rgb")
        file.write(large, photometric="rgb")
    for name in ("first", "last", "unmarked"):
        path = tmp_path / f"{name}.tif"
        header = read_header(path)
        assert ((header.width, header.height), header.cautions) == ((12, 8), ())
        assert_close(decode(path).samples, wanted, rtol=0, atol=1e-6)


def test_of_equal_pages_the_first_is_read_with_a_word(tmp_path, pixels):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for page in (pixels, pixels // 2):
            file.write(page, photometric="rgb")
    assert read_header(tmp_path / "a.tif").cautions == (
        "has 2 pages of one size, of which the first is read",
    )
    assert_close(decode(tmp_path / "a.tif").samples, planes(pixels), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"photometric": "cielab"}, "holds CIELab of 16 bits, 3 samples a pixel; needed: RGB or"),
        ({"photometric": "ycbcr"}, "holds YCbCr of 16 bits, 3 samples"),
        ({"photometric": "minisblack", "extrasamples": [2, 0]}, "holds gray of 16 bits, 3 sam"),
    ],
)
def test_other_colours_of_sixteen_bits_are_refused(tmp_path, pixels, options, why):
    tifffile.imwrite(tmp_path / "a.tif", pixels.astype(np.uint16), **options)
    with pytest.raises(InputError, match=why):
        decode(tmp_path / "a.tif")


def test_signed_samples_and_raw_of_sensors_are_refused(tmp_path, pixels):
    tifffile.imwrite(tmp_path / "a.tif", pixels[..., 0].astype(np.int8), photometric="minisblack")
    with pytest.raises(InputError, match=r"a\.tif: has samples with a sign"):
        decode(tmp_path / "a.tif")
    tifffile.imwrite(tmp_path / "b.tif", pixels[..., 0].astype(np.uint16), photometric="cfa")
    with pytest.raises(InputError, match=r"b\.tif: holds what a sensor saw, camera raw by the"):
        decode(tmp_path / "b.tif")


def test_lab_of_eight_bits_is_the_colour_that_it_says(tmp_path, pixels):
    colour = Image.fromarray(np.full((4, 5, 3), (180, 120, 60), dtype=np.uint8))
    colour.convert("LAB").save(tmp_path / "a.tif")
    wanted = planes(np.asarray(colour))
    assert_close(decode(tmp_path / "a.tif").samples, wanted, rtol=0, atol=0.02)  # 8 bits of a, b


@pytest.mark.parametrize("bits", [10, 14])
def test_sixteen_bits_that_hold_fewer_are_warned_of(tmp_path, pixels, write_png16, bits):
    levels = (pixels.astype(np.uint16) * 257) >> (16 - bits)
    for index in range(3):
        write_png16(tmp_path / f"{index}.png", levels)
    told = rf"no value of its files of 16 bits is above \d+ of 65535.*{bits} bits.*{2**bits - 1}"
    with pytest.warns(PimperWarning, match=told):
        load_views(tmp_path)
    given = Encoding(response="linear", saturation=float(2**bits - 1))
    found = load_views(tmp_path, encoding=given).images[0]
    assert_close(found.double(), torch.from_numpy(levels / (2**bits - 1)).movedim(-1, 0))
    load_views(tmp_path, encoding=LINEAR)  # full scale is insisted on


@pytest.mark.parametrize("channels", [1, 3])
def test_a_transparent_colour_is_alpha(tmp_path, pixels, channels):
    array = pixels[..., 0] if channels == 1 else pixels
    array[2:4] = 77
    path = tmp_path / "a.png"
    Image.fromarray(array).save(path)
    data = path.read_bytes()
    told = struct.pack(">H", 77) * channels
    path.write_bytes(data[:33] + chunk(b"tRNS", told) + data[33:])
    wanted = torch.from_numpy((np.atleast_3d(array) != 77).any(axis=2)).float()
    assert torch.equal(decode(path).alpha, wanted)


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@pytest.mark.parametrize("noise", [0.0, 0.0005])
def test_saturation_is_found_alike_at_either_depth(tmp_path, noise):
    """A sensor that saturates at 0.8 of full scale, then noise as of a dark frame taken away."""
    generator = np.random.default_rng(6)
    found = []
    light = 1.3 * generator.random((4, 60, 90, 3)) ** 3
    light = light.clip(max=0.8) + noise * generator.standard_normal(light.shape)
    for kind in (np.uint8, np.uint16):
        folder = tmp_path / np.dtype(kind).name
        folder.mkdir()
        full = np.iinfo(kind).max
        for index, one in enumerate(light):
            levels = (full * one).round().clip(0, full).astype(kind)
            tifffile.imwrite(folder / f"{index}.tif", levels, photometric="rgb")
        with pytest.warns(PimperWarning, match="pile up at"):
            found.append(load_views(folder, encoding=Encoding(response="linear")).images)
    assert_close(*found, rtol=0, atol=0.006)  # a level of 255
