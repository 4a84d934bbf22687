import math

import cv2
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from torch.nn.functional import avg_pool2d
from torch.testing import assert_close

from pimper_torch.io.decode import decode, read_header, rotated
from pimper_torch.io.header import focal_from_exif
from pimper_torch.runtime.errors import InputError

PLANES = {"photometric": "rgb", "planarconfig": "separate"}


@pytest.fixture
def deep():
    return np.random.default_rng(73).integers(0, 65536, (6, 10, 4), dtype=np.uint16)


def assert_decoded(path, array, full):
    """Check that colours and alpha equal an array, up to rounding of float32."""
    decoded = decode(path)
    found = [decoded.samples] if decoded.alpha is None else [decoded.samples, decoded.alpha[None]]
    planes = torch.from_numpy(np.atleast_3d(array).astype(np.float32) / full).permute(2, 0, 1)
    assert_close(torch.cat(found), planes, rtol=0, atol=1e-7)
    assert read_header(path).channels == len(decoded.samples)


@pytest.mark.parametrize("suffix", ["png", "tif", "bmp"])
def test_eight_bits_are_read_unchanged(tmp_path, pixels, suffix):
    for array in (pixels, pixels[..., 0]):
        Image.fromarray(array).save(tmp_path / f"a.{suffix}")
        assert_decoded(tmp_path / f"a.{suffix}", array, 255)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_sixteen_bit_png_keeps_its_depth(tmp_path, deep, write_png16, channels):
    array = deep[..., 0] if channels == 1 else deep[..., :channels]
    write_png16(tmp_path / "a.png", array)
    wanted = deep[..., [0, 0, 0, 1]] if channels == 2 else array  # gray with alpha becomes colour
    assert_decoded(tmp_path / "a.png", wanted, 65535)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": "zlib", "predictor": True},
        {"byteorder": ">"},
        {"bigtiff": True},
        {"tile": (16, 16)},
    ],
)
def test_sixteen_bit_tiff_keeps_its_depth(tmp_path, deep, options):
    path = tmp_path / "a.tif"
    for array, kind in ((deep[..., 0], "minisblack"), (deep[..., :3], "rgb"), (deep, "rgb")):
        more = {"extrasamples": ["unassalpha"]} if array is deep else {}
        tifffile.imwrite(path, array, photometric=kind, **more, **options)
        assert_decoded(path, array, 65535)


def test_sixteen_bit_tiff_in_planes_or_packed_keeps_its_depth(tmp_path, deep):
    path, rgb = tmp_path / "a.tif", deep[..., :3]
    tifffile.imwrite(path, np.moveaxis(rgb, -1, 0), **PLANES)
    assert_decoded(path, rgb, 65535)
    for packed in (cv2.IMWRITE_TIFF_COMPRESSION_LZW, cv2.IMWRITE_TIFF_COMPRESSION_PACKBITS):
        for array in (rgb[..., ::-1], deep[..., [2, 1, 0, 3]]):
            cv2.imwrite(str(path), array, [cv2.IMWRITE_TIFF_COMPRESSION, packed])
            assert_decoded(path, deep[..., : array.shape[2]], 65535)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_are_rotated_by_exif_orientation(tmp_path, pixels, deep, write_png16, orientation):
    exif, rgb = Image.Exif(), deep[..., :3]
    exif[274] = orientation
    more = {"extratags": [(274, "H", 1, orientation, True)]}
    Image.fromarray(pixels).save(tmp_path / "8.png", exif=exif)
    Image.fromarray(pixels).save(tmp_path / "8.tif", exif=exif)
    write_png16(tmp_path / "16.png", rgb, eXIf=exif.tobytes()[6:])
    tifffile.imwrite(tmp_path / "16.tif", rgb, photometric="rgb", **more)
    tifffile.imwrite(tmp_path / "16.planes.tif", np.moveaxis(rgb, -1, 0), **PLANES, **more)
    for path in tmp_path.iterdir():
        array, full = (pixels, 255) if path.name.startswith("8") else (rgb, 65535)
        assert_decoded(path, rotated(array, orientation), full)
        header = read_header(path)
        assert decode(path).samples.shape[1:] == (header.height, header.width)


def test_a_palette_is_expanded_to_colours_and_alpha(tmp_path, pixels):
    flat = Image.fromarray(pixels // 128 * 255)
    flat.quantize(8).save(tmp_path / "a.png")
    assert_decoded(tmp_path / "a.png", pixels // 128 * 255, 255)
    flat.quantize(8).save(tmp_path / "b.png", transparency=bytes([0] + [255] * 7))
    assert set(decode(tmp_path / "b.png").alpha.unique().tolist()) == {0.0, 1.0}


@pytest.mark.parametrize("channels", [1, 3])
def test_a_transparent_colour_becomes_alpha(tmp_path, pixels, channels):
    array = pixels[..., 0] if channels == 1 else pixels
    array[2:4] = 77
    transparent = 77 if channels == 1 else (77,) * 3
    Image.fromarray(array).save(tmp_path / "a.png", transparency=transparent)
    wanted = torch.from_numpy((np.atleast_3d(array) != 77).any(axis=2)).float()
    assert torch.equal(decode(tmp_path / "a.png").alpha, wanted)


def test_one_bit_images_are_gray_and_a_jpeg_gives_its_first_image(tmp_path, pixels):
    Image.fromarray(pixels[..., 0] > 99).save(tmp_path / "a.png")
    assert_decoded(tmp_path / "a.png", pixels[..., 0] > 99, 1)
    small = Image.fromarray(pixels[:4, :6])
    Image.fromarray(pixels).save(
        tmp_path / "a.jpg", format="MPO", save_all=True, append_images=[small], quality=95
    )
    Image.fromarray(pixels).save(tmp_path / "b.jpg", quality=95)
    assert torch.equal(decode(tmp_path / "a.jpg").samples, decode(tmp_path / "b.jpg").samples)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(
    ("size", "least", "wanted"),
    [
        ((96, 64), (13, 8), (24, 16)),  # an eighth is too narrow
        ((96, 64), (12, 8), (12, 8)),
        ((96, 64), (49, 30), (96, 64)),
        ((97, 64), (12, 8), (97, 64)),  # the last column would be partial
        ((100, 64), (12, 8), (25, 16)),
    ],
)
def test_jpeg_is_decoded_at_the_smallest_sufficient_size(
    tmp_path, orientation, size, least, wanted
):
    exif, (wide, high) = Image.Exif(), size
    exif[274] = orientation
    v, u = np.mgrid[:high, :wide] + 0.5
    ramps = np.stack([20 + 2 * u, 30 + 3 * v, 200 - u - v], axis=-1).round().astype(np.uint8)
    stored = rotated(rotated(rotated(ramps, orientation), orientation), orientation)
    Image.fromarray(stored).save(tmp_path / "a.jpg", exif=exif, quality=98, subsampling=0)
    upright = decode(tmp_path / "a.jpg").samples
    assert upright.shape[:0:-1] == size
    found = decode(tmp_path / "a.jpg", least).samples
    assert found.shape[:0:-1] == wanted
    mean = avg_pool2d(upright, size[0] // wanted[0])
    assert_close(found, mean, rtol=0, atol=3 / 255)  # JPEG rounds
    Image.fromarray(ramps[..., 0]).save(tmp_path / "grey.jpg")
    assert decode(tmp_path / "grey.jpg", least).levels.shape == (1, *wanted[::-1])


def test_only_jpeg_is_shrunk_while_it_is_decoded(tmp_path, pixels):
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert torch.equal(decode(tmp_path / "a.png", (3, 2)).levels, decode(tmp_path / "a.png").levels)


# 30 mm on a 22.5 mm wide sensor with 4500 pixels: 200 pixels a millimetre.
PLANE = {0x920A: 30.0, 0xA20E: 5080.0, 0xA210: 2}


@pytest.mark.parametrize(
    ("tags", "size", "focal_px"),
    [
        # On 36 mm x 24 mm the 35 mm equivalent is the focal length itself.
        ({0xA405: 50}, (3600, 2400), 5000),
        ({0xA405: 50}, (2400, 3600), 5000),
        (PLANE, (4500, 3000), 6000),
        (PLANE | {0xA20E: 2000.0, 0xA210: 3}, (4500, 3000), 6000),
        (PLANE | {0xA20E: 200.0, 0xA210: 4}, (4500, 3000), 6000),
        (PLANE | {0xA002: 4500, 0xA003: 3000}, (900, 600), 1200),
        (PLANE | {0xA002: 4500, 0xA003: 3000}, (600, 900), 1200),
        # The equivalent includes a digital zoom in files of telephones (55 mm for a lens of 28),
        # the focal plane never does; if both exist, the focal plane is used.
        ({0xA404: 1.951, 0xA405: 55, 0x920A: 4.0}, (3600, 2400), 5500),
        (PLANE | {0xA404: 2.5}, (4500, 3000), 15000),
        (PLANE | {0xA404: 2.5, 0xA405: 36}, (4500, 3000), 15000),
        (PLANE | {0xA404: 2.5, 0xA405: 90}, (4500, 3000), 15000),
        *[(PLANE | {0xA404: zoom}, (4500, 3000), 6000) for zoom in (None, 0, 0.6, "two", math.nan)],
        ({0xA404: 0, 0xA405: 28}, (3600, 2400), 2800),
        # Unusable tags give no focal length.
        ({}, (4500, 3000), math.nan),
        ({0xA405: "fifty"}, (4500, 3000), math.nan),
        ({0x920A: 30.0}, (4500, 3000), math.nan),
        (PLANE | {0xA20E: 0.0}, (4500, 3000), math.nan),
        (PLANE | {0xA210: 9}, (4500, 3000), math.nan),
        (PLANE | {0x920A: math.inf}, (4500, 3000), math.nan),
    ],
)
def test_the_focal_length_follows_from_exif(tags, size, focal_px):
    assert focal_from_exif(tags, *size) == pytest.approx(focal_px, nan_ok=True)


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


@pytest.mark.parametrize("name", ["cut.png", "cut.tif", "checksum.png"])
def test_a_damaged_deep_file_is_refused_by_name(tmp_path, deep, write_png16, name):
    path = tmp_path / name
    if path.suffix == ".png":
        write_png16(path, deep[..., :3])
    else:
        tifffile.imwrite(path, deep, photometric="rgb", extrasamples=["unassalpha"])
    data = bytearray(path.read_bytes())
    if name == "checksum.png":
        data[-30] ^= 1
    path.write_bytes(data if name == "checksum.png" else data[:-80])
    with pytest.raises(InputError, match=rf"{name}: cannot be read; it seems cut short, damaged"):
        decode(path)


def test_other_formats_are_refused_by_name(tmp_path, pixels):
    (tmp_path / "text.jpg").write_text("no photograph")
    Image.fromarray(pixels).save(tmp_path / "gif.png", format="gif")
    Image.fromarray(pixels).convert("CMYK").save(tmp_path / "cmyk.jpg")
    for name, why in {
        "text.jpg": "is not a readable JPEG, PNG or TIFF",
        "gif.png": "is not a readable JPEG, PNG or TIFF image, but GIF",
        "cmyk.jpg": "is CMYK, for printing; needed: RGB.*ImageMagick",
        "gone.png": r"cannot be read \(No such file or directory\)",
    }.items():
        with pytest.raises(InputError, match=f"{name}: {why}"):
            decode(tmp_path / name)


@pytest.mark.parametrize(
    ("limit", "most", "why"),
    [
        ("PIL.Image.MAX_IMAGE_PIXELS", 10, "has more than 160 million pixels"),
        ("pimper_torch.io.decode.MAX_PIXELS", 95, "has 12 x 8 pixels"),
        ("pimper_torch.io.decode._MAX_BYTES", 10, r"has \d+ bytes"),
    ],
)
def test_images_too_large_are_refused(tmp_path, monkeypatch, pixels, limit, most, why):
    Image.fromarray(pixels).save(tmp_path / "bomb.png")
    monkeypatch.setattr(limit, most)
    with pytest.raises(InputError, match=rf"bomb\.png: {why}"):
        decode(tmp_path / "bomb.png")
