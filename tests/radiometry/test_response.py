import pytest
import torch
from torch.testing import assert_close

from pimper_torch.radiometry import Encoding, Gamma, Linear, Srgb, find_saturation
from pimper_torch.radiometry.response import curve_from_table
from pimper_torch.runtime.errors import ConfigError, InputError

LEVELS = torch.arange(256, dtype=torch.float64)


def tabulated(exponents, levels=LEVELS):
    rows = [3.0 + 50 * (levels / levels[-1]) ** exponent for exponent in exponents]
    return curve_from_table(levels, torch.stack(rows))


RESPONSES = {
    "linear": Linear(),
    "srgb": Srgb(),
    "gamma": Gamma(exponent=2.2),
    "curve": tabulated([2.0]),
    "curves": tabulated([1.0, 2.0, 2.6]),
}


@pytest.mark.parametrize("name", RESPONSES)
def test_encoding_inverts_decoding(name):
    encoded = torch.linspace(0, 1, 3 * 7 * 11, dtype=torch.float64).reshape(3, 7, 11)
    response = RESPONSES[name]
    radiance = response.linear_from_encoded(encoded)
    # The two pieces of sRGB differ by 3e-8 where they join.
    assert_close(response.encoded_from_linear(radiance), encoded, rtol=0, atol=1e-7)
    assert_close(float(radiance[..., -1, -1].max()), 1.0)
    assert (name == "linear") == bool((radiance - encoded).abs().max() < 1e-3)
    assert bool((radiance.flatten(1).diff(dim=1) > 0).all())


@pytest.mark.parametrize("name", RESPONSES)
def test_gradients_are_those_of_the_curve(name):
    torch.manual_seed(3)
    encoded = (0.1 + 0.8 * torch.rand(3, 2, 5, dtype=torch.float64)).requires_grad_()
    response = RESPONSES[name]
    assert torch.autograd.gradcheck(response.linear_from_encoded, encoded)
    assert torch.autograd.gradcheck(response.encoded_from_linear, encoded)


def test_a_gamma_of_one_is_linear_and_the_srgb_curve_is_near_a_gamma_of_two_point_two():
    encoded = torch.linspace(0, 1, 101, dtype=torch.float64)
    assert_close(Gamma(exponent=1.0).linear_from_encoded(encoded), encoded)
    off = Gamma(exponent=2.2).linear_from_encoded(encoded) - Srgb().linear_from_encoded(encoded)
    assert 1e-3 < off.abs().max() < 0.01  # close, as IEC 61966-2-1 intends, but not equal


def test_a_table_is_interpolated_linearly():
    curve = RESPONSES["curve"]
    wanted = (3 + 50 * (LEVELS / 255) ** 2) / 53
    assert_close(curve.linear_from_encoded(LEVELS / 255), wanted)
    centre = curve.linear_from_encoded((LEVELS[:-1] + 0.5) / 255)
    assert_close(centre, (wanted[1:] + wanted[:-1]) / 2)
    assert curve.bits == 8


def test_each_colour_has_its_own_curve():
    encoded = torch.full((2, 3, 4, 4), 0.5, dtype=torch.float64)
    found = RESPONSES["curves"].linear_from_encoded(encoded)[0, :, 0, 0]
    assert_close(
        found, (3 + 50 * 0.5 ** torch.tensor([1.0, 2.0, 2.6])).double() / 53, atol=1e-4, rtol=0
    )
    with pytest.raises(InputError, match="3 colours, the photograph 1"):
        RESPONSES["curves"].linear_from_encoded(encoded[:, :1])


def test_fourteen_bit_data_saturate_at_the_end_of_the_table():
    levels = torch.linspace(0, 16383, 100, dtype=torch.float64)
    curve = curve_from_table(levels, (levels[None] + 1) ** 1.5)
    assert curve.bits == 16
    at = torch.tensor([16383, 16384, 65535], dtype=torch.float64) / 65535
    assert_close(curve.linear_from_encoded(at), torch.ones(3, dtype=torch.float64))
    fractions = curve_from_table(levels / 16383, levels[None])
    assert fractions.bits is None


def broken(change):
    levels, radiance = LEVELS.clone(), LEVELS[None] ** 2
    return change(levels, radiance)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x, y: (x[:16], y[:, :16]), "16 entries; needed: at least 17"),
        (lambda x, y: (x, y.expand(2, -1)), "2 colours; needed: 1 or 3"),
        (lambda x, y: (x, y.where(x != 9, torch.nan)), "not finite"),
        (
            lambda x, y: (x, y.where(x != 9, 64.0)),
            r"radiance does not increase after level 8 \(64, ",
        ),
        (lambda x, y: (x.where(x != 9, 20.0), y), "the levels do not increase after level 20"),
        (lambda x, y: (x + 1, y), "first level is 1; needed: 0"),
        (lambda x, y: (x, y - 5), "radiance of -5; needed: 0 or more"),
        (lambda x, y: (x / 2, y), "last level is 127.5; needed: 1 .*255"),
        (lambda x, y: (x * 1000, y), "last level is 255000"),
    ],
)
def test_tables_that_are_not_curves_are_rejected(change, message):
    with pytest.raises(InputError, match=message):
        curve_from_table(*broken(change))


@pytest.mark.parametrize("exponent", [0.0, -2.2, float("nan"), float("inf")])
def test_an_impossible_exponent_is_rejected(exponent):
    with pytest.raises(InputError, match="exponent of a gamma curve"):
        Gamma(exponent=exponent)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"response": 22.0}, "response is 22.0"),
        ({"black": -1.0}, "black is -1.0"),
        ({"saturation": 0.0}, "saturation is 0.0"),
        ({"saturation": 500.0, "black": 512.0}, "above black"),
        ({"saturation": (15000, 15000, float("nan"))}, "saturation"),
    ],
)
def test_impossible_settings_are_rejected(settings, message):
    with pytest.raises(ConfigError, match=message):
        Encoding(**settings)


def photographs(generator, count=4, pixels=20_000, brightest=1.5):
    """Return radiance with a decreasing density that extends beyond 1."""
    return brightest * torch.rand(count, pixels, generator=generator, dtype=torch.float64) ** 3


def tally(levels, full):
    counts = torch.stack([torch.bincount(one, minlength=full + 1) for one in levels])
    return counts.sum(dim=0), (counts >= 8).long().sum(dim=0)


@pytest.mark.parametrize(
    ("full", "white"), [(65535, 15000), (65535, 4095), (65535, 65535), (255, 255), (255, 235)]
)
def test_the_saturation_level_is_detected(generator, full, white):
    levels = (white * photographs(generator)).round().clamp(max=white).long()
    assert find_saturation(*tally(levels, full)) == white


def test_saturation_of_stretched_twelve_bit_data_is_detected(generator):
    levels = 4 * (4000 * photographs(generator)).round().clamp(max=4000).long()
    assert find_saturation(*tally(levels, 65535)) == 16000


def test_noise_and_hot_pixels_do_not_hide_saturation(generator):
    levels = (15000 * photographs(generator)).clamp(max=15000)
    levels = levels + 8 * torch.randn(levels.shape, generator=generator, dtype=torch.float64)
    levels = levels.round().clamp_min(0).long()
    found = find_saturation(*tally(levels, 65535))
    assert abs(found - 15000) <= 8
    many = levels.repeat(1, 20)  # 1.6 million pixels, of which 2 are hot
    many[0, :2] = 60000
    assert abs(find_saturation(*tally(many, 65535)) - 15000) <= 8


def test_a_tail_of_the_histogram_is_not_saturation(generator):
    below = 15000 * photographs(generator, brightest=0.9)
    assert find_saturation(*tally(below.round().long(), 65535)) is None
    bell = 9000 + 2000 * torch.randn(4, 20_000, generator=generator)
    assert find_saturation(*tally(bell.round().clamp_min(0).long(), 65535)) is None
    even = torch.randint(40, 200, (4, 20_000), generator=generator)
    assert find_saturation(*tally(even, 255)) is None


def test_a_bright_noise_free_face_is_not_saturation(generator):
    levels = (100 * photographs(generator, brightest=1.0)).round().long()
    for index, level in enumerate((120, 130, 140, 150)):
        levels[index, :2000] = level
        levels[index, 2000:4000] = torch.linspace(20, level, 2000).long()
    assert find_saturation(*tally(levels, 255)) is None


def test_cards_of_few_levels_and_empty_images_have_no_saturation():
    card = torch.zeros(3, 1000, dtype=torch.long)
    card[:, :500] = 200
    assert find_saturation(*tally(card, 255)) is None
    assert find_saturation(torch.zeros(256).long(), torch.zeros(256).long()) is None
    assert find_saturation(*tally(0 * card, 255)) is None
