"""Interpolation in pyramids against torch's grid_sample and the formula of levels."""

import math

import pytest
import torch
from torch.nn.functional import grid_sample
from torch.testing import assert_close

from pimper_torch.kernels.lookup import bilinear, blended_level, corners


@pytest.mark.parametrize("real", [torch.float32, torch.uint8])
def test_bilinear_samples_are_those_of_grid_sample(real):
    generator = torch.Generator().manual_seed(8)
    height, width = 5, 7
    images = (255 * torch.rand(3, height, width, generator=generator)).to(real)
    # Beyond all borders, on pixel centres, and on the last row and column.
    x = torch.cat([10 * torch.rand(60, generator=generator) - 1.5, torch.tensor([0.0, 6.0, 3.0])])
    y = torch.cat([8 * torch.rand(60, generator=generator) - 1.5, torch.tensor([4.0, 4.0, 0.0])])
    rows = images.reshape(3, -1).numpy()
    points = list(zip(x.tolist(), y.tolist(), strict=True))
    at = [corners(height, width, u, v) for u, v in points]
    found = torch.tensor([[bilinear(row, *corner) for corner in at] for row in rows])
    grid = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], dim=-1)
    expected = grid_sample(
        images[:, None].float(),
        grid.expand(3, 1, -1, 2),
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )[:, 0, 0]
    assert_close(found, expected, rtol=0, atol=1e-3)  # of values up to 255, in float32


def test_nan_points_are_clamped_into_the_image():
    index, right, below, across, down = corners(5, 7, math.nan, math.nan)
    assert (index, right, below, across, down) == (0, 1, 7, 0, 0)
    assert corners(5, 7, math.inf, math.inf)[:3] == (5 * 7 - 1, 0, 0)


@pytest.mark.parametrize(
    ("area", "expected"),
    [(0.2, (0, 0.0)), (2.0, (0, 0.5)), (4.0, (1, 0.0)), (1e9, (3, 0.0))],
)
def test_a_footprint_of_four_times_the_area_is_one_level_coarser(area, expected):
    level, blend = blended_level(area, 4)
    assert level == expected[0]
    assert blend == pytest.approx(expected[1], abs=1e-6)
