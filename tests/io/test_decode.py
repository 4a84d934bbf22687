import math

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_torch.doors.io.decode import decode, read_header, rotated
from pimper_torch.doors.io.header import focal_from_exif
from pimper_torch.runtime.errors import InputError


@pytest.fixture
def deep():
    return np.random.default_rng(73).integers(0, 65536, (6, 10, 4), dtype=np.uint16)


def as_planes(array, full):
    planes = torch.from_numpy(array.astype(np.float32) / full)
    return (planes[..., None] if planes.ndim == 2 else planes).permute(2, 0, 1)


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_eight_bits_come_back_as_they_were(tmp_path, pixels, suffix):
    for array in (pixels, pixels[..., 0]):
        path = tmp_path / f"a.{suffix}"
        Image.fromarray(array).save(path)
        assert_close(decode(path).samples, as_planes(array, 255))
        assert decode(path).alpha is None


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bit_png_keeps_its_depth(tmp_path, deep, write_png16, channels):
    array = deep[..., 0] if channels == 1 else deep[..., :channels]
    write_png16(tmp_path / "a.png", array)
    decoded = decode(tmp_path / "a.png")
    colour = array[..., :3] if channels > 1 else array
    assert_close(decoded.samples, as_planes(colour, 65535), rtol=0, atol=1e-7)  # float32 rounding
    assert read_header(tmp_path / "a.png").channels == (1 if channels == 1 else 3)
    if channels == 4:
        assert_close(decoded.alpha, as_planes(array[..., 3], 65535)[0], rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    "options",
    [
        {"compression": None},
        {"compression": "zlib", "predictor": True},
        {"compression": None, "byteorder": ">"},
    ],
)
def test_sixteen_bit_tiff_keeps_its_depth(tmp_path, deep, options):
    path = tmp_path / "a.tif"
    for array in (deep[..., 0], deep[..., :3]):
        kind = "rgb" if array.ndim == 3 else "minisblack"
        tifffile.imwrite(path, array, photometric=kind, **options)
        assert_close(decode(path).samples, as_planes(array, 65535), rtol=0, atol=1e-7)


def test_sixteen_bit_tiff_with_alpha_planes_or_packbits_keeps_its_depth(
    tmp_path, deep, write_packbits_tiff
):
    path, rgb = tmp_path / "a.tif", deep[..., :3]
    tifffile.imwrite(path, deep, photometric="rgb", extrasamples=["unassalpha"])
    assert_close(decode(path).samples, as_planes(rgb, 65535), rtol=0, atol=1e-7)
    assert_close(decode(path).alpha, as_planes(deep[..., 3], 65535)[0], rtol=0, atol=1e-7)
    planes = np.moveaxis(rgb, -1, 0)
    tifffile.imwrite(path, planes, photometric="rgb", planarconfig="separate")
    assert_close(decode(path).samples, as_planes(rgb, 65535), rtol=0, atol=1e-7)
    write_packbits_tiff(path, rgb, orientation=6)
    upright = np.rot90(rgb, -1).copy()
    assert_close(decode(path).samples, as_planes(upright, 65535), rtol=0, atol=1e-7)
    assert (read_header(path).width, read_header(path).height) == (6, 10)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_files_are_turned_as_exif_says(tmp_path, pixels, orientation):
    exif = Image.Exif()
    exif[274] = orientation
    path = tmp_path / "a.png"
    Image.fromarray(pixels).save(path, exif=exif)
    assert_close(decode(path).samples, as_planes(rotated(pixels, orientation), 255))
    header = read_header(path)
    assert decode(path).samples.shape[1:] == (header.height, header.width)


def test_a_palette_gives_its_colours_and_its_transparency(tmp_path, pixels):
    flat = Image.fromarray(pixels // 128 * 255)
    flat.quantize(8).save(tmp_path / "a.png")
    assert_close(decode(tmp_path / "a.png").samples, as_planes(pixels // 128 * 255, 255))
    flat.quantize(8).save(tmp_path / "b.png", transparency=bytes([0] + [255] * 7))
    alpha = decode(tmp_path / "b.png").alpha
    assert alpha is not None
    assert set(alpha.unique().tolist()) == {0.0, 1.0}


def test_one_bit_and_cmyk_files_are_photographs_too(tmp_path, pixels):
    Image.fromarray(pixels[..., 0] > 99).save(tmp_path / "a.png")
    assert_close(decode(tmp_path / "a.png").samples[0], torch.from_numpy(pixels[..., 0] > 99) * 1.0)
    Image.fromarray(pixels).convert("CMYK").save(tmp_path / "b.jpg")
    assert decode(tmp_path / "b.jpg").samples.shape == (3, 8, 12)


def test_the_focal_length_follows_from_the_35_mm_equivalent():
    # On 36 mm x 24 mm the equivalent is the focal length itself.
    assert focal_from_exif({0xA405: 50}, 3600, 2400) == pytest.approx(5000)
    assert focal_from_exif({0xA405: 50}, 2400, 3600) == pytest.approx(5000)


def test_the_focal_length_follows_from_the_focal_plane():
    # 30 mm on a 22.5 mm wide sensor with 4500 pixels: 200 pixels a millimetre.
    for unit, per_unit in ((2, 5080.0), (3, 2000.0), (4, 200.0)):
        tags = {0x920A: 30.0, 0xA20E: per_unit, 0xA210: unit}
        assert focal_from_exif(tags, 4500, 3000) == pytest.approx(6000)
        resized = tags | {0xA002: 4500, 0xA003: 3000}
        assert focal_from_exif(resized, 900, 600) == pytest.approx(1200)
        assert focal_from_exif(resized, 600, 900) == pytest.approx(1200)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {0xA405: "fifty"},
        {0x920A: 30.0},
        {0x920A: 30.0, 0xA20E: 0.0},
        {0x920A: 30.0, 0xA20E: 5080.0, 0xA210: 9},
        {0x920A: math.inf, 0xA20E: 5080.0},
    ],
)
def test_exif_that_says_nothing_useful_gives_no_focal_length(tags):
    assert math.isnan(focal_from_exif(tags, 4500, 3000))


def zoomed(zoom, equivalent=28, focal_mm=4.0, **plane):
    tags = {0xA404: zoom, 0xA405: equivalent, 0x920A: focal_mm}
    return focal_from_exif(tags | plane.get("plane", {}), 3600, 2400)


def test_a_digital_zoom_multiplies_the_focal_length_that_the_focal_plane_gives():
    plane = {0xA20E: 200.0, 0xA210: 4}  # 200 pixels a millimetre
    assert zoomed(2.5, equivalent=0, focal_mm=18.0, plane=plane) == pytest.approx(9000)
    # An equivalent of 36 mm leaves the zoom out, one of 90 mm has it: the plane is the same.
    for equivalent in (36, 90):
        assert zoomed(2.5, equivalent, focal_mm=18.0, plane=plane) == pytest.approx(9000)


@pytest.mark.parametrize("zoom", [None, 0, 0.6, "two", math.nan])
def test_a_digital_zoom_that_is_none_changes_nothing(zoom):
    plane = {0xA20E: 200.0, 0xA210: 4}
    assert zoomed(zoom, equivalent=0, focal_mm=18.0, plane=plane) == pytest.approx(3600)
    assert zoomed(zoom) == pytest.approx(2800)


def test_a_digital_zoom_is_part_of_the_equivalent():
    assert zoomed(1.951, 55) == pytest.approx(5500)  # as telephones write it, of 28 mm


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_a_truncated_file_is_refused_by_name(tmp_path, suffix):
    path = tmp_path / f"cut.{suffix}"
    noise = np.random.default_rng(74).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    whole = path.read_bytes()
    for fraction in (0.0, 0.01, 0.5, 0.9):
        path.write_bytes(whole[: int(fraction * len(whole))])
        with pytest.raises(InputError, match=f"cut.{suffix}"):
            decode(path)


def test_a_truncated_deep_file_is_refused_by_name(tmp_path, deep, write_png16):
    path = tmp_path / "cut.png"
    write_png16(path, deep[..., :3])
    path.write_bytes(path.read_bytes()[:-80])
    with pytest.raises(InputError, match=r"cut\.png"):
        decode(path)
    path = tmp_path / "cut.tif"
    tifffile.imwrite(path, deep, photometric="rgb", extrasamples=["unassalpha"])
    path.write_bytes(path.read_bytes()[:-80])
    with pytest.raises(InputError, match=r"cut\.tif"):
        decode(path)


def test_other_formats_and_depths_are_refused_by_name(tmp_path, pixels, deep, write_png16):
    (tmp_path / "text.jpg").write_text("no photograph")
    with pytest.raises(InputError, match=r"text\.jpg: holds no JPEG, PNG or TIFF"):
        decode(tmp_path / "text.jpg")
    Image.fromarray(pixels).save(tmp_path / "gif.png", format="gif")
    with pytest.raises(InputError, match=r"gif\.png: holds no JPEG, PNG or TIFF"):
        decode(tmp_path / "gif.png")
    tifffile.imwrite(tmp_path / "float.tif", pixels[..., 0].astype(np.float32))
    with pytest.raises(InputError, match=r"float\.tif.*float32; needed: 8 or 16 bits"):
        decode(tmp_path / "float.tif")
    write_png16(tmp_path / "la.png", deep[..., :2])
    with pytest.raises(InputError, match=r"la\.png.*without transparency"):
        decode(tmp_path / "la.png")


def test_a_decompression_bomb_is_refused(tmp_path, monkeypatch, pixels):
    Image.fromarray(pixels).save(tmp_path / "bomb.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 10)
    with pytest.raises(InputError, match=r"bomb\.png.*more than 160 million pixels"):
        decode(tmp_path / "bomb.png")


@pytest.mark.parametrize("channels", [1, 3])
def test_a_tiff_of_floats_is_told_from_no_tiff(tmp_path, channels):
    values = np.zeros((8, 12) if channels == 1 else (8, 12, 3), dtype=np.float32)
    kind = "minisblack" if channels == 1 else "rgb"
    tifffile.imwrite(tmp_path / "float.tif", values, photometric=kind)
    with pytest.raises(InputError, match=r"float\.tif: its samples are float32; needed: 8 or 16"):
        decode(tmp_path / "float.tif")


def test_messages_do_not_speak_for_libraries(tmp_path, deep, write_png16):
    write_png16(tmp_path / "deep.png", deep[..., :3])
    data = bytearray((tmp_path / "deep.png").read_bytes())
    data[-30] ^= 1  # a checksum of what is compressed
    (tmp_path / "deep.png").write_bytes(data)
    with pytest.raises(InputError, match=r"16-bit samples cannot be read, the file seems damaged"):
        decode(tmp_path / "deep.png")
    with pytest.raises(InputError, match=r"a\.png: cannot be read \(No such file or directory\)"):
        decode(tmp_path / "a.png")
