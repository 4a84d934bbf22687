import pytest
import torch
from torch.testing import assert_close

from pimper_torch.coarse.matching import Level, Matcher, Windows, pair
from pimper_torch.evidence.scenes.cameras import arc_cameras
from pimper_torch.kernels.switch import using

OFFSETS = [-0.2, -0.003, 0.0, 0.004, 0.05]


def textured(width=61, height=47, dtype=torch.float32):
    """Five views of noise, each with pixels that say nothing, at the borders too."""
    generator = torch.Generator().manual_seed(0)
    tone = 0.2 + torch.rand(5, height, width, generator=generator, dtype=torch.float64)
    usable = torch.rand(5, height, width, generator=generator) > 0.1
    usable[:, 5:9, 10:30] = False
    usable[2, 20] = False
    cameras = arc_cameras(
        5, width=width, height=height, focal_px=90.0, distance=4.0, sway_deg=0.0
    ).to(dtype)
    return Level(tone=tone.to(dtype), usable=usable, cameras=cameras)


def field(level):
    height, width = level.tone.shape[-2:]
    rows = torch.linspace(0.2, 0.3, height, dtype=level.tone.dtype)
    return rows[:, None] + 0.02 * torch.sin(torch.arange(width).to(rows))


@pytest.mark.parametrize("radius", [1, 2])
@pytest.mark.parametrize("best", [1, 3, 9])
def test_windows_correlate_as_torch_says(radius, best):
    level, sources = textured(), torch.tensor([0, 1, 3, 4])
    windows = Windows(radius=radius, likeness=0.3, contrast=0.005, best=best)
    found = Matcher(level, pair(level, 2, sources), windows).scores(field(level), OFFSETS)
    with using("torch"):
        expected = Matcher(level, pair(level, 2, sources), windows).scores(field(level), OFFSETS)
    assert not bool(expected[:, ~level.usable[2]].any())
    assert float((expected != 0).double().mean()) > 0.5
    # Where a place is within rounding of the border between pixels, either may be the nearest.
    off = (found - expected).abs()
    assert float((off > 1e-4).double().mean()) < 1e-3
    assert_close(found[off <= 1e-4], expected[off <= 1e-4], atol=1e-4, rtol=0)


def test_windows_of_a_narrow_picture_and_of_one_without_anything_are_scored():
    level = textured(width=3, height=300)
    windows = Windows(radius=2, likeness=0.3, contrast=0.005, best=2)
    sources = torch.tensor([1, 3])
    with using("torch"):
        expected = Matcher(level, pair(level, 2, sources), windows).scores(field(level), OFFSETS)
    found = Matcher(level, pair(level, 2, sources), windows).scores(field(level), OFFSETS)
    assert float(((found - expected).abs() > 1e-4).double().mean()) < 1e-2
    dark = level.replace(usable=torch.zeros_like(level.usable))
    none = Matcher(dark, pair(dark, 2, sources), windows).scores(field(dark), OFFSETS)
    assert_close(none, torch.zeros_like(none))


def test_double_precision_is_torchs():
    level = textured(dtype=torch.float64)
    windows = Windows(radius=2, likeness=0.3, contrast=0.005, best=2)
    matcher = Matcher(level, pair(level, 2, torch.tensor([1, 3])), windows)
    assert matcher.scores(field(level), OFFSETS).dtype == torch.float64
