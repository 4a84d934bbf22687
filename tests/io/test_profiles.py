import io
import struct
import warnings
import zlib

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image, ImageCms
from torch.testing import assert_close

from pimper_torch.io.decode import read_header
from pimper_torch.io.photographs import load_views
from pimper_torch.io.profiles import colour_of_codes, read_profile
from pimper_torch.radiometry import Curve, Encoding, Gamma, Linear, Srgb, linear_from_srgb
from pimper_torch.radiometry.primaries import (
    ADOBE_RGB,
    DISPLAY_P3,
    REC_709,
    in_srgb_primaries,
    primaries_of,
)
from pimper_torch.runtime.errors import InputError, PimperWarning

SRGB = tuple(primaries_of(REC_709).T.tolist())
P3 = tuple(primaries_of(DISPLAY_P3).T.tolist())
IDENTITY = b"curv" + bytes(8)


def power(exponent):
    return b"curv" + bytes(4) + struct.pack(">IH", 1, round(256 * exponent))


def sampled(values):
    levels = np.round(65535 * np.asarray(values)).astype(">u2")
    return b"curv" + bytes(4) + struct.pack(">I", len(levels)) + levels.tobytes()


def parametric(kind, *values):
    numbers = b"".join(struct.pack(">i", round(65536 * value)) for value in values)
    return b"para" + bytes(4) + struct.pack(">HH", kind, 0) + numbers


SRGB_PIECES = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
SRGB_CURVE = parametric(3, *SRGB_PIECES)
ADOBE = Gamma(exponent=563 / 256)


@pytest.fixture
def stored(pixels):
    return torch.from_numpy(pixels / 255).movedim(-1, 0)


@pytest.fixture
def three(tmp_path):
    """Write one image three times, and read it."""

    def read(array, encoding=None, **options):
        folder = tmp_path / "three"
        folder.mkdir(exist_ok=True)
        for index in range(3):
            Image.fromarray(array).save(folder / f"{index}.png", **options)
        return load_views(folder, encoding=encoding or Encoding()).images[0].double()

    return read


@pytest.mark.parametrize(
    ("curve", "response"),
    [
        (IDENTITY, Linear()),
        (parametric(0, 1.0), Linear()),
        (sampled([0, 1]), Linear()),
        (power(1.8), Gamma(exponent=461 / 256)),
        (parametric(0, 2.5), Gamma(exponent=2.5)),
        (sampled(linear_from_srgb(torch.linspace(0, 1, 1024, dtype=torch.float64))), Srgb()),
        (SRGB_CURVE, Srgb()),
        (parametric(4, *SRGB_PIECES, 0, 0), Srgb()),
    ],
)
@pytest.mark.parametrize("space", [b"RGB ", b"GRAY"])
def test_standard_responses_are_recognised(make_profile, curve, response, space):
    colour = read_profile(make_profile(curve, SRGB, space=space))
    assert (colour.response, colour.srgb_from_file, colour.trouble) == (response, None, "")


def test_profiles_of_littlecms_are_read_as_by_littlecms(make_profile, pixels):
    colour = read_profile(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    assert (colour.response, colour.srgb_from_file, colour.trouble) == (Srgb(), None, "")
    profile = make_profile(SRGB_CURVE, P3, name="Display P3")
    colour = read_profile(profile)
    assert (colour.response, colour.source) == (Srgb(), 'the ICC profile "Display P3"')
    dull = pixels // 4 + 96  # inside sRGB, and not saturated
    given = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    wanted = ImageCms.profileToProfile(
        Image.fromarray(dull), given, ImageCms.createProfile("sRGB"), renderingIntent=1
    )
    oracle = linear_from_srgb(torch.from_numpy(np.array(wanted) / 255).movedim(-1, 0))
    encoded = torch.from_numpy(dull / 255).movedim(-1, 0)
    found = in_srgb_primaries(linear_from_srgb(encoded), colour.srgb_from_file)
    scale = (oracle / found).median()
    assert_close(scale * found, oracle, rtol=0, atol=0.006)  # half a level of 255, twice
    assert float((linear_from_srgb(encoded) - oracle).abs().max()) > 0.02


@pytest.mark.parametrize(
    ("curve", "wanted"),
    [
        (parametric(1, 2.0, 0.8, 0.2), lambda x: (0.8 * x + 0.2) ** 2),
        (parametric(1, 2.0, 1.25, -0.25), lambda x: (1.25 * x - 0.25).clamp_min(0) ** 2),
        (parametric(2, 2.0, 0.8, 0.1, 0.19), lambda x: (0.8 * x + 0.1) ** 2 + 0.19),
        (parametric(3, 2.0, 1.0, 0.0, 0.5, 0.5), lambda x: torch.where(x < 0.5, x / 2, x**2)),
        (
            parametric(4, 2.0, 0.8, 0.1, 0.25, 0.3, 0.19, 0.2306),
            lambda x: torch.where(x < 0.3, x / 4 + 0.2306, (0.8 * x + 0.1) ** 2 + 0.19),
        ),
        (sampled(np.linspace(0, 1, 300) ** 1.7), lambda x: x**1.7),
        (
            (power(1.5), IDENTITY, sampled(np.linspace(0, 1, 500) ** 2)),
            lambda x: torch.stack([x**1.5, x, x**2]),
        ),
        (
            tuple(sampled(np.linspace(0, 1, 500) ** power) for power in (1.2, 1.6, 2)),
            lambda x: torch.stack([x**1.2, x**1.6, x**2]),
        ),
    ],
)
def test_curves_agree_with_the_icc_standard(make_profile, curve, wanted):
    levels = torch.linspace(0, 1, 256, dtype=torch.float64)
    response = read_profile(make_profile(curve, SRGB)).response
    found = response.linear_from_encoded(levels.expand(3, 1, -1))[:, 0]
    # Rounded to 1/65536; interpolation of 300 entries of a power of 1.7 is off by 1e-5.
    assert_close(found, wanted(levels).expand(3, -1), rtol=0, atol=1e-4)


def test_control_characters_are_removed_from_the_profile_name(make_profile):
    assert read_profile(make_profile(IDENTITY, SRGB, name='a\x1b[31m"b')).source == (
        'the ICC profile "a[31mb"'
    )
    text = "Größe".encode("utf-16-be")
    name = b"mluc" + bytes(4) + struct.pack(">IIHHII", 1, 12, 0, 0, len(text), 28) + text
    assert "Größe" in read_profile(make_profile(IDENTITY, SRGB, more={b"desc": name})).source


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"space": b"CMYK", "curve": (IDENTITY,)}, "is for CMYK, not RGB or gray"),
        ({"space": b"GRAY", "more": {b"kTRC": b""}}, "has tone curves of an unknown type"),
        ({"connection": b"Lab "}, "has tone curves in CIELab"),
        ({"curve": sampled(np.linspace(1, 0, 20))}, "does not rise"),
        ({"curve": sampled([0.2, 0.2])}, "does not rise"),
        ({"curve": b"curv" + bytes(4) + struct.pack(">I", 2**31)}, "cut short"),
        ({"curve": power(0.0)}, "has a gamma of 0"),
        ({"curve": parametric(9, 1.0)}, "unknown function"),
        ({"curve": parametric(1, 2.0, 0.0, 0.5)}, "flat"),
        ({"curve": b"text" + bytes(20)}, "unknown type"),
        ({"columns": ((0, 0, 0),) * 3}, "primaries that are linearly dependent"),
        ({"columns": ()}, "has no primaries"),
    ],
)
def test_unsupported_profiles_are_named(make_profile, settings, why):
    given = {"curve": IDENTITY, "columns": SRGB} | settings
    assert why in read_profile(make_profile(**given)).trouble


def test_damaged_profiles_raise_no_error(make_profile):
    profile = make_profile(sampled(np.linspace(0, 1, 64) ** 2), P3)
    generator = np.random.default_rng(5)
    for size in range(0, len(profile), 7):
        read_profile(profile[:size])
    for _ in range(400):
        data = bytearray(profile)
        for at in generator.integers(0, len(data), 4):
            data[at] = generator.integers(0, 256)
        colour = read_profile(bytes(data))
        assert colour.response is None or isinstance(colour.response, Linear | Srgb | Gamma | Curve)
    assert read_profile(b"").trouble == "is damaged"
    assert read_profile(bytes(2**23)).trouble == "is damaged"


def gamma(number):
    return {"gAMA": struct.pack(">I", number)}


WIDE = {"cHRM": struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)}
SAME = {"cHRM": struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000)}
NOT_SRGB = "has gAMA .* and cHRM that are not sRGB's"


@pytest.mark.parametrize(
    ("chunks", "response", "wide"),
    [
        (gamma(45_455), Srgb(), False),  # the gamma that stands for sRGB without its chunk
        (gamma(45_455) | SAME, Srgb(), False),
        (SAME, None, False),
        (gamma(100_000) | WIDE | {"sRGB": b"\0"}, Srgb(), False),
        ({"cICP": bytes([1, 8, 0, 1])}, Linear(), False),
        ({"cICP": bytes([12, 13, 0, 1])} | gamma(100_000), Srgb(), True),
        ({"cICP": bytes([2, 13, 0, 1])}, Srgb(), False),
        ({}, None, False),
    ],
)
def test_colour_chunks_of_png_are_applied(tmp_path, pixels, png_with, chunks, response, wide):
    png_with(tmp_path / "a.png", pixels, **chunks)
    colour = read_header(tmp_path / "a.png").colour
    assert (colour.response, colour.srgb_from_file is not None) == (response, wide)
    assert colour.trouble == ""


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


@pytest.mark.parametrize(
    ("exif", "response"),
    [
        (exif_of(65535, "R03"), ADOBE),
        (exif_of(65535, "R03", exponent=2.2), ADOBE),
        (exif_of(1, "R98"), None),
        (exif_of(65535), None),
    ],
)
def test_adobe_rgb_in_exif_is_applied(tmp_path, pixels, exif, response):
    Image.fromarray(pixels).save(tmp_path / "a.jpg", exif=exif)
    colour = read_header(tmp_path / "a.jpg").colour
    assert colour.response == response
    assert (colour.srgb_from_file is not None) == (response == ADOBE)
    if response == ADOBE:  # it shares red and blue with sRGB
        assert float(colour.srgb_from_file[0, 1]) < -0.3


@pytest.mark.parametrize(
    ("write", "why"),
    [
        ({"chunks": gamma(100_000)}, f"PNG {NOT_SRGB}"),
        ({"chunks": gamma(50_000) | SAME}, f"PNG {NOT_SRGB}"),
        ({"chunks": gamma(0)}, f"PNG {NOT_SRGB}"),
        ({"chunks": WIDE}, f"PNG {NOT_SRGB}"),
        ({"chunks": {"cICP": b"\1"}}, "PNG's cICP is not for full-range RGB"),
        ({"chunks": {"cICP": bytes([9, 16, 0, 1])}}, "names transfer 16, as of HDR or film"),
        ({"chunks": {"cICP": bytes([5, 13, 0, 1])}}, "names primaries 5"),
        ({"chunks": {"iCCP": b"x\0\0" + zlib.compress(bytes(2**19))}}, "an ICC profile is damaged"),
        ({"chunks": {"iCCP": b"x\0\0damaged"}}, "an ICC profile is damaged"),
        ({"exif": exif_of(exponent=1.0, orientation=1)}, "EXIF has a gamma that is not sRGB's"),
        ({"table": tuple(range(0, 65536, 257))}, "TIFF has a TransferFunction"),
        ({"profile": True}, 'the ICC profile "print" is a table of colours without tone curves'),
    ],
)
def test_unsupported_colours_are_refused(
    tmp_path, pixels, stored, png_with, make_profile, write, why
):
    for index in range(3):
        path = tmp_path / f"{index}.{'tif' if 'table' in write else 'png'}"
        if "table" in write:
            tags = [(301, "H", 256, write["table"], True)]
            tifffile.imwrite(path, pixels, photometric="rgb", extratags=tags)
        elif "profile" in write:
            broken = make_profile(IDENTITY, SRGB, name="print").replace(b"rTRC", b"xTRC")
            Image.fromarray(pixels).save(path, icc_profile=broken)
        elif "exif" in write:
            Image.fromarray(pixels).save(path, exif=write["exif"])
        else:
            png_with(path, pixels, **write["chunks"])
    told = rf"0\.(png|tif): .*{why}.*, which is not supported; needed: sRGB.*photographs\.response"
    with pytest.raises(InputError, match=told):
        load_views(tmp_path)
    told = rf"3 of 3 .*{why}.*, which is not supported; the given response"
    with pytest.warns(PimperWarning, match=told):
        found = load_views(tmp_path, encoding=Encoding(response="srgb")).images[0]
    assert_close(found.double(), linear_from_srgb(stored), rtol=0, atol=1e-6)


def test_the_curve_of_bt_709_is_inverted():
    response = colour_of_codes(1, 1, "cICP").response
    light = torch.linspace(0, 1, 200, dtype=torch.float64)
    encoded = torch.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)
    assert_close(response.linear_from_encoded(encoded), light, rtol=0, atol=1e-4)


def test_each_photograph_has_its_own_curve_in_any_format(tmp_path, make_profile):
    ramp = np.repeat(np.linspace(0, 255, 64).round().astype(np.uint8)[None, :, None], 3, axis=2)
    array = np.repeat(ramp, 16, axis=0)
    stored = torch.from_numpy(array / 255).movedim(-1, 0)
    exponents = {"0.png": 1.0, "1.tif": 461 / 256, "2.jpg": 461 / 256, "3.png": None}
    for name, exponent in exponents.items():
        profile = None if exponent is None else make_profile(power(exponent), SRGB)
        options = {"quality": 100} if name == "2.jpg" else {}
        Image.fromarray(array).save(tmp_path / name, icc_profile=profile, **options)
    for image, (name, exponent) in zip(load_views(tmp_path).images, exponents.items(), strict=True):
        wanted = linear_from_srgb(stored) if exponent is None else stored**exponent
        assert_close(image.double(), wanted, rtol=0, atol=0.03 if name == "2.jpg" else 1e-6)


def test_saturation_is_found_per_profile(tmp_path, make_profile):
    generator = np.random.default_rng(6)
    for index in range(6):
        exponent, top = ((1.0, 180), (2.0, 220))[index % 2]
        levels = (330 * generator.random((60, 90, 3)) ** 3).clip(max=top).astype(np.uint8)
        profile = make_profile(power(exponent), SRGB)
        Image.fromarray(levels).save(tmp_path / f"{index}.png", icc_profile=profile)
    with pytest.warns(PimperWarning) as told:
        images = load_views(tmp_path).images
    assert {"180", "220"} == {str(one.message).split("pile up at ")[1][:3] for one in told}
    for index in range(6):
        assert float(images[index].max()) == 1
        assert 0.01 < float((images[index] == 1).float().mean()) < 0.3


def test_a_given_response_overrides_the_profile(three, pixels, stored, make_profile, tmp_path):
    mine = {"icc_profile": make_profile(IDENTITY, SRGB, name="mine")}
    told = r'3 of 3 photographs \(0\.png, .*srgb is given, but the ICC profile "mine" states linear'
    with pytest.warns(PimperWarning, match=told):
        found = three(pixels, Encoding(response="srgb"), **mine)
    assert_close(found, linear_from_srgb(stored), rtol=0, atol=1e-6)
    with pytest.warns(PimperWarning, match=r"response 1\.8 is given, but .* states linear"):
        three(pixels, Encoding(response=1.8), **mine)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = three(pixels, Encoding(response="linear"), **mine)
        assert_close(found, stored, rtol=0, atol=1e-6)
        np.save(tmp_path / "measured.npy", np.arange(256.0) ** 2)
        found = three(pixels, Encoding(response=tmp_path / "measured.npy"), **mine)
    assert_close(found, stored**2, rtol=0, atol=1e-6)


def test_colours_are_converted_to_srgb_primaries_and_stay_saturated(three, pixels, make_profile):
    array = (pixels // 2 + 50).astype(np.uint8)
    array[2, 3] = (255, 120, 120)
    found = three(array, icc_profile=make_profile(IDENTITY, P3))
    linear = torch.from_numpy(array / 255).movedim(-1, 0)
    # From DCI-P3 with white D65 to BT.709, by SMPTE EG 432-1 and IEC 61966-2-1.
    matrix = torch.tensor(
        [[1.2249, -0.2247, 0.0], [-0.0420, 1.0419, 0.0], [-0.0197, -0.0786, 1.0979]]
    ).double()
    wanted = torch.einsum("ij,jhw->ihw", matrix, linear) / 1.2249
    usual = torch.ones(8, 12, dtype=torch.bool)
    usual[2, 3] = False
    inside = usual & (wanted >= 0).all(dim=0)
    assert inside.float().mean() > 0.6
    assert_close(found[:, inside], wanted[:, inside], rtol=0, atol=2e-3)  # 4 digits of D65
    assert float(found[:, usual].max()) < 0.98
    assert (found[:, 2, 3] == 1).all()  # red contributes to all channels


def test_primaries_of_adobe_rgb_and_p3_equal_those_of_their_profiles():
    # From Adobe's AdobeRGB1998.icc and Apple's Display P3.icc.
    adobe = [[0.60974, 0.20528, 0.14919], [0.31111, 0.62567, 0.06322], [0.01947, 0.06087, 0.74457]]
    p3 = [[0.51512, 0.29198, 0.15710], [0.24120, 0.69225, 0.06657], [-0.00105, 0.04189, 0.78407]]
    for chromaticities, wanted in ((ADOBE_RGB, adobe), (DISPLAY_P3, p3)):
        found = primaries_of(chromaticities)
        assert_close(found, torch.tensor(wanted, dtype=torch.float64), rtol=0, atol=2e-4)


@pytest.mark.parametrize("orientation", [0, 9, 200])
def test_an_unknown_orientation_counts_as_upright(three, pixels, stored, orientation):
    told = rf"3 of 3 .* has an EXIF orientation of {orientation}, not of 1 to 8; .* as upright"
    with pytest.warns(PimperWarning, match=told):
        found = three(pixels, exif=exif_of(orientation=orientation))
    assert_close(found, linear_from_srgb(stored), rtol=0, atol=1e-6)
