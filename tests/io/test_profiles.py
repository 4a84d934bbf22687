import struct
import warnings
import zlib

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from torch.testing import assert_close

from pimper_torch.doors.io.decode import decode, read_header
from pimper_torch.doors.io.photographs import load_views
from pimper_torch.doors.io.profiles import colour_of_codes
from pimper_torch.ground.radiometry import Encoding, Gamma, Linear, Srgb, linear_from_srgb
from pimper_torch.ground.radiometry.primaries import ADOBE_RGB, DISPLAY_P3, REC_709, primaries_of
from pimper_torch.runtime.errors import PimperWarning

LINEAR_CURVE = b"curv" + bytes(8)


def power(exponent):
    return b"curv" + bytes(4) + struct.pack(">IH", 1, round(256 * exponent))


@pytest.fixture
def columns():
    return tuple(primaries_of(REC_709).T.tolist())


@pytest.fixture
def stored(pixels):
    return torch.from_numpy(pixels / 255).movedim(-1, 0)


@pytest.fixture
def three(tmp_path):
    """Write one picture three times, and read what comes out."""

    def read(write, suffix, **settings):
        folder = tmp_path / "three"
        folder.mkdir(exist_ok=True)
        for index in range(3):
            write(folder / f"{index}.{suffix}")
        return load_views(folder, **settings).images[0].double()

    return read


@pytest.mark.parametrize(("suffix", "tolerance"), [("png", 1e-6), ("tif", 1e-6), ("jpg", 0.03)])
def test_a_profile_of_gamma_1_8_is_followed_in_every_format(
    three, make_profile, columns, suffix, tolerance
):
    profile = make_profile(power(1.8), columns)
    ramp = np.repeat(np.linspace(0, 255, 64).round().astype(np.uint8)[None, :, None], 3, axis=2)
    array = np.repeat(ramp, 16, axis=0)
    options = {"quality": 100} if suffix == "jpg" else {}

    def write(path):
        Image.fromarray(array).save(path, icc_profile=profile, **options)

    wanted = torch.from_numpy(array / 255).movedim(-1, 0) ** (461 / 256)
    assert_close(three(write, suffix), wanted, rtol=0, atol=tolerance)


def gamma(number):
    return {"gAMA": struct.pack(">I", number)}


WIDE = {"cHRM": struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)}
SAME = {"cHRM": struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000)}


@pytest.mark.parametrize(
    ("chunks", "response", "wide"),
    [
        (gamma(100_000), Linear(), False),
        (gamma(45_455), Srgb(), False),  # what programs without a chunk for sRGB write for it
        (gamma(45_455) | SAME, Srgb(), False),
        (gamma(50_000) | WIDE, Gamma(exponent=2.0), True),
        (gamma(100_000) | {"sRGB": b"\0"}, Srgb(), False),
        ({"cICP": bytes([1, 8, 0, 1])}, Linear(), False),
        ({"cICP": bytes([12, 13, 0, 1])} | gamma(100_000), Srgb(), True),
        ({"cICP": bytes([2, 4, 0, 1])}, Gamma(exponent=2.2), False),
        ({}, None, False),
    ],
)
def test_chunks_of_png_are_followed(tmp_path, pixels, png_with, chunks, response, wide):
    png_with(tmp_path / "a.png", pixels, **chunks)
    colour = read_header(tmp_path / "a.png").colour
    assert (colour.response, colour.srgb_from_file is not None) == (response, wide)
    assert colour.trouble == ""


def test_a_profile_goes_before_gamma_and_a_damaged_one_is_named(
    tmp_path, pixels, png_with, make_profile, columns
):
    profile = b"x\0\0" + zlib.compress(make_profile(LINEAR_CURVE, columns))
    png_with(tmp_path / "a.png", pixels, **gamma(45_455), iCCP=profile)
    assert read_header(tmp_path / "a.png").colour.response == Linear()
    png_with(tmp_path / "b.png", pixels, iCCP=b"x\0\0" + zlib.compress(bytes(2**19)))
    assert read_header(tmp_path / "b.png").colour.trouble == "is damaged"
    png_with(tmp_path / "c.png", pixels, cICP=b"\1")
    assert "damaged chunk" in read_header(tmp_path / "c.png").colour.trouble


def test_the_curve_of_bt_709_is_inverted():
    response = colour_of_codes(1, 1, "cICP").response
    light = torch.linspace(0, 1, 200, dtype=torch.float64)
    encoded = torch.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)
    assert_close(response.linear_from_encoded(encoded), light, rtol=0, atol=1e-4)


def exif_of(colour_space=None, index=None, exponent=None, orientation=None):
    exif = Image.Exif()
    tags = exif.get_ifd(0x8769)
    if colour_space is not None:
        tags[0xA001] = colour_space
    if exponent is not None:
        tags[0xA500] = exponent
    if index is not None:
        exif.get_ifd(0xA005)[1] = index
        tags[0xA005] = {1: index}
    if orientation is not None:
        exif[274] = orientation
    return exif


def test_a_camera_that_says_adobe_rgb_in_exif_alone_is_believed(tmp_path, pixels):
    Image.fromarray(pixels).save(tmp_path / "a.jpg", exif=exif_of(65535, "R03"))
    colour = read_header(tmp_path / "a.jpg").colour
    assert colour.response == Gamma(exponent=563 / 256)
    assert colour.srgb_from_file is not None
    # Adobe RGB shares red and blue with sRGB: of its green, red holds nothing positive.
    assert float(colour.srgb_from_file[0, 1]) < -0.3
    Image.fromarray(pixels).save(tmp_path / "b.jpg", exif=exif_of(1, "R98"))
    assert read_header(tmp_path / "b.jpg").colour.response is None
    Image.fromarray(pixels).save(tmp_path / "c.jpg", exif=exif_of(65535))
    assert read_header(tmp_path / "c.jpg").colour.response is None
    Image.fromarray(pixels).save(tmp_path / "d.jpg", exif=exif_of(exponent=1.0))
    assert read_header(tmp_path / "d.jpg").colour.response == Linear()


def test_the_transfer_function_of_a_tiff_is_followed(tmp_path, pixels):
    curve = tuple(int(65535 * (level / 255) ** 1.5) for level in range(256))
    for count in (1, 3):
        tifffile.imwrite(
            tmp_path / "a.tif",
            pixels,
            photometric="rgb",
            extratags=[(301, "H", 256 * count, curve * count, True)],
        )
        response = read_header(tmp_path / "a.tif").colour.response
        level = torch.linspace(0, 1, 100, dtype=torch.float64)
        assert_close(response.linear_from_encoded(level), level**1.5, rtol=0, atol=1e-4)
    tifffile.imwrite(
        tmp_path / "b.tif", pixels, photometric="rgb", extratags=[(301, "H", 20, curve[:20], True)]
    )
    assert "no table" in read_header(tmp_path / "b.tif").colour.trouble


def test_photographs_of_one_set_have_a_curve_each(tmp_path, pixels, stored, make_profile, columns):
    for index, exponent in enumerate((1.0, 1.8, None)):
        profile = None if exponent is None else make_profile(power(exponent), columns)
        Image.fromarray(pixels).save(tmp_path / f"{index}.png", icc_profile=profile)
    images = load_views(tmp_path).images.double()
    wanted = torch.stack([stored, stored ** (461 / 256), linear_from_srgb(stored)])
    assert_close(images, wanted, rtol=0, atol=1e-6)


def test_saturation_is_found_in_files_of_each_profile_by_itself(tmp_path, make_profile, columns):
    generator = np.random.default_rng(6)
    for index in range(6):
        exponent, top = ((1.0, 180), (2.0, 220))[index % 2]
        levels = (330 * generator.random((60, 90, 3)) ** 3).clip(max=top).astype(np.uint8)
        profile = make_profile(power(exponent), columns)
        Image.fromarray(levels).save(tmp_path / f"{index}.png", icc_profile=profile)
    with pytest.warns(PimperWarning) as told:
        images = load_views(tmp_path).images
    assert {"180", "220"} == {str(one.message).split("pile up at ")[1][:3] for one in told}
    for index in range(6):
        assert float(images[index].max()) == 1
        assert 0.01 < float((images[index] == 1).float().mean()) < 0.3


def test_what_is_given_wins_and_a_contradiction_is_named(
    three, pixels, stored, make_profile, columns, tmp_path
):
    profile = make_profile(LINEAR_CURVE, columns, name="mine")

    def write(path):
        Image.fromarray(pixels).save(path, icc_profile=profile)

    told = r'3 of 3 photographs \(0\.png, .*srgb is given, but the ICC profile "mine" says linear'
    with pytest.warns(PimperWarning, match=told):
        found = three(write, "png", encoding=Encoding(response="srgb"))
    assert_close(found, linear_from_srgb(stored), rtol=0, atol=1e-6)
    with pytest.warns(PimperWarning, match=r"response 1\.8 is given, but .* says linear"):
        three(write, "png", encoding=Encoding(response=1.8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_close(
            three(write, "png", encoding=Encoding(response="linear")), stored, rtol=0, atol=1e-6
        )
        np.save(tmp_path / "measured.npy", np.arange(256.0) ** 2)
        found = three(write, "png", encoding=Encoding(response=tmp_path / "measured.npy"))
    assert_close(found, stored**2, rtol=0, atol=1e-6)


def test_a_profile_that_cannot_be_followed_is_named_with_what_to_give(
    three, pixels, stored, make_profile, columns
):
    broken = make_profile(LINEAR_CURVE, columns, name="print").replace(b"rTRC", b"xTRC")

    def write(path):
        Image.fromarray(pixels).save(path, icc_profile=broken)

    told = (
        r'3 of 3 .*"print" is a table of colours without tone curves, and cannot be followed; '
        r"taken is the response srgb\. Give the true one by `photographs\.response`"
    )
    with pytest.warns(PimperWarning, match=told):
        found = three(write, "png")
    assert_close(found, linear_from_srgb(stored), rtol=0, atol=1e-6)
    three(write, "png", encoding=Encoding(response="srgb"))  # given: nothing to say


def test_colours_come_in_the_primaries_of_srgb_and_saturation_stays(three, pixels, make_profile):
    profile = make_profile(LINEAR_CURVE, tuple(primaries_of(DISPLAY_P3).T.tolist()))
    array = (pixels // 2 + 50).astype(np.uint8)
    array[2, 3] = (255, 120, 120)

    def write(path):
        Image.fromarray(array).save(path, icc_profile=profile)

    found = three(write, "png")
    linear = torch.from_numpy(array / 255).movedim(-1, 0)
    # Of DCI-P3 with white D65 to BT.709, as SMPTE EG 432-1 and IEC 61966-2-1 give it.
    matrix = torch.tensor(
        [[1.2249, -0.2247, 0.0], [-0.0420, 1.0419, 0.0], [-0.0197, -0.0786, 1.0979]]
    ).double()
    wanted = torch.einsum("ij,jhw->ihw", matrix, linear) / 1.2249
    usual = torch.ones(8, 12, dtype=torch.bool)
    usual[2, 3] = False
    inside = usual & (wanted >= 0).all(dim=0)
    assert inside.float().mean() > 0.6
    assert_close(found[:, inside], wanted[:, inside], rtol=0, atol=2e-3)  # 4 digits; D65's
    assert float(found[:, usual].max()) < 0.98
    assert (found[:, 2, 3] == 1).all()  # red is mixed into all


def test_primaries_of_adobe_rgb_and_p3_are_those_of_their_profiles():
    # Of Adobe's AdobeRGB1998.icc and Apple's Display P3.icc.
    adobe = [[0.60974, 0.20528, 0.14919], [0.31111, 0.62567, 0.06322], [0.01947, 0.06087, 0.74457]]
    p3 = [[0.51512, 0.29198, 0.15710], [0.24120, 0.69225, 0.06657], [-0.00105, 0.04189, 0.78407]]
    for chromaticities, wanted in ((ADOBE_RGB, adobe), (DISPLAY_P3, p3)):
        found = primaries_of(chromaticities)
        assert_close(found, torch.tensor(wanted, dtype=torch.float64), rtol=0, atol=2e-4)


@pytest.mark.parametrize("orientation", [0, 9, 200])
def test_an_orientation_that_exif_does_not_know_is_named_and_taken_as_upright(
    three, pixels, stored, orientation
):
    def write(path):
        Image.fromarray(pixels).save(path, exif=exif_of(orientation=orientation))

    told = rf"3 of 3 .* has an EXIF orientation of {orientation}, not of 1 to 8; .* as upright"
    with pytest.warns(PimperWarning, match=told):
        found = three(write, "png")
    assert_close(found, linear_from_srgb(stored), rtol=0, atol=1e-6)


def test_the_first_picture_of_a_jpeg_of_several_is_read(tmp_path, pixels):
    small = Image.fromarray(pixels[:4, :6])
    Image.fromarray(pixels).save(
        tmp_path / "a.jpg", format="MPO", save_all=True, append_images=[small], quality=95
    )
    Image.fromarray(pixels).save(tmp_path / "b.jpg", quality=95)
    assert torch.equal(decode(tmp_path / "a.jpg").samples, decode(tmp_path / "b.jpg").samples)


def test_cmyk_is_read_with_a_word(three, pixels):
    def write(path):
        Image.fromarray(pixels).convert("CMYK").save(path, quality=95)

    with pytest.warns(PimperWarning, match="is CMYK, made for printing"):
        three(write, "jpg")
