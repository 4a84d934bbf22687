import pytest
import torch

from pimper_bench.metrics.in_view import pitted_percent


@pytest.fixture
def everywhere():
    return torch.ones(80, 120, dtype=torch.bool)


def test_a_pit_has_a_larger_error_than_its_surroundings(everywhere):
    angle = torch.full((80, 120), 30.0)
    assert pitted_percent(angle, everywhere) == 0  # wrong everywhere, but not pitted
    angle[40:42, 50:53] = 60.0
    assert pitted_percent(angle, everywhere) == 0  # nor slightly larger
    angle = torch.linspace(0, 60, 120).expand(80, 120)
    assert pitted_percent(angle, everywhere) == 0  # nor with a gradient
    angle = torch.full((80, 120), 2.0)
    angle[40:42, 50:53] = 12.0
    assert pitted_percent(angle, everywhere) == pytest.approx(100 * 6 / (80 * 120))
    angle[40:42, 50:53] = 6.5
    assert pitted_percent(angle, everywhere) == 0


def test_unknown_pixels_are_neither_pits_nor_surroundings(everywhere):
    angle = torch.full((80, 120), 2.5)
    known = everywhere.clone()
    known[:, 60:] = False
    angle[:, 60:] = torch.nan
    assert pitted_percent(angle, known) == 0
    angle[:, 60:] = 0.0
    assert pitted_percent(angle, known) == 0
    angle[10, 59] = 30.0
    assert pitted_percent(angle, known) == pytest.approx(100 / (80 * 60))
