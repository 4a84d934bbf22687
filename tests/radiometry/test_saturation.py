import pytest
import torch

from pimper_torch.radiometry import find_saturation


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
