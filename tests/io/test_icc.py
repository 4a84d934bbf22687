import io
import struct

import numpy as np
import pytest
import torch
from PIL import Image, ImageCms
from torch.testing import assert_close

from pimper_torch.doors.io.profiles import read_profile
from pimper_torch.ground.radiometry import Curve, Gamma, Linear, Srgb, linear_from_srgb
from pimper_torch.ground.radiometry.primaries import in_srgb_primaries

# Of Apple's Display P3, adapted to D50.
P3 = ((0.51512, 0.2412, -0.00105), (0.29198, 0.69225, 0.04189), (0.1571, 0.06657, 0.78407))
SRGB = ((0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.7141))
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


@pytest.fixture
def levels():
    return torch.linspace(0, 1, 256, dtype=torch.float64)


def test_a_linear_profile_is_linear_and_a_gamma_a_power(make_profile):
    assert read_profile(make_profile(IDENTITY, SRGB)).response == Linear()
    assert read_profile(make_profile(parametric(0, 1.0), SRGB)).response == Linear()
    assert read_profile(make_profile(sampled([0, 1]), SRGB)).response == Linear()
    assert read_profile(make_profile(power(1.8), SRGB)).response == Gamma(exponent=461 / 256)
    assert read_profile(make_profile(parametric(0, 2.5), SRGB)).response == Gamma(exponent=2.5)


def test_every_way_to_write_srgb_is_srgb(make_profile, levels):
    steps = torch.linspace(0, 1, 1024, dtype=torch.float64)
    ways = [
        ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
        make_profile(sampled(linear_from_srgb(steps)), SRGB),
        make_profile(parametric(3, *SRGB_PIECES), SRGB),
        make_profile(parametric(4, *SRGB_PIECES, 0, 0), SRGB),
    ]
    for profile in ways:
        colour = read_profile(profile)
        assert colour.response == Srgb()
        assert (colour.srgb_from_file, colour.trouble) == (None, "")
    assert read_profile(make_profile(power(2.2), SRGB)).response != Srgb()


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
    ],
)
def test_curves_are_what_the_standard_says(make_profile, levels, curve, wanted):
    found = read_profile(make_profile(curve, SRGB)).response.linear_from_encoded(levels)
    # Rounded to 1/65536; 300 entries of a power of 1.7 are off by 1e-5 between them.
    assert_close(found, wanted(levels), rtol=0, atol=1e-4)


def test_colours_may_have_a_curve_each(make_profile, levels):
    curves = (power(1.5), IDENTITY, sampled(np.linspace(0, 1, 500) ** 2))
    response = read_profile(make_profile(curves, SRGB)).response
    found = response.linear_from_encoded(levels.expand(3, 1, -1))[:, 0]
    assert_close(found, torch.stack([levels**1.5, levels, levels**2]), rtol=0, atol=1e-4)


def test_gray_has_one_curve_and_no_primaries(make_profile):
    colour = read_profile(make_profile(power(1.8), space=b"GRAY"))
    assert (colour.response, colour.srgb_from_file) == (Gamma(exponent=461 / 256), None)
    assert colour.trouble == ""


def test_primaries_become_those_of_srgb_as_littlecms_has_them(make_profile, pixels):
    profile = make_profile(parametric(3, *SRGB_PIECES), P3, name="Display P3")
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
    assert_close(scale * found, oracle, rtol=0, atol=0.006)  # half a level of 255 each way
    assert float((linear_from_srgb(encoded) - oracle).abs().max()) > 0.02


def test_the_name_is_told_without_what_a_terminal_obeys(make_profile):
    assert read_profile(make_profile(IDENTITY, SRGB, name='a\x1b[31m"b')).source == (
        'the ICC profile "a[31mb"'
    )
    text = "Größe".encode("utf-16-be")
    name = b"mluc" + bytes(4) + struct.pack(">IIHHII", 1, 12, 0, 0, len(text), 28) + text
    assert "Größe" in read_profile(make_profile(IDENTITY, SRGB, more={b"desc": name})).source


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"space": b"CMYK"}, "is of CMYK, not of RGB or gray"),
        ({"connection": b"Lab "}, "has tone curves in CIELab"),
        ({"curve": sampled(np.linspace(1, 0, 20))}, "does not rise"),
        ({"curve": sampled([0.2, 0.2])}, "does not rise"),
        ({"curve": b"curv" + bytes(4) + struct.pack(">I", 2**31)}, "cut short"),
        ({"curve": power(0.0)}, "has a gamma of 0"),
        ({"curve": parametric(9, 1.0)}, "unknown function"),
        ({"curve": parametric(1, 2.0, 0.0, 0.5)}, "flat"),
        ({"curve": b"text" + bytes(20)}, "unknown type"),
        ({"columns": ((0, 0, 0),) * 3}, "primaries that span no colours"),
        ({"columns": ()}, "has no primaries"),
    ],
)
def test_what_cannot_be_followed_is_named(make_profile, settings, why):
    space = settings.get("space", b"RGB ")
    given = {"curve": IDENTITY, "columns": SRGB} | settings
    if space == b"CMYK":
        given["curve"] = (IDENTITY,)
    assert why in read_profile(make_profile(**given)).trouble


def test_a_table_of_colours_without_curves_is_named(make_profile):
    profile = make_profile(IDENTITY, SRGB, more={b"A2B0": b"mft2" + bytes(60)})
    assert read_profile(profile).response == Linear()
    broken = profile.replace(b"rTRC", b"xTRC")
    assert read_profile(broken).trouble == "is a table of colours without tone curves"


def test_no_damage_raises(make_profile):
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
