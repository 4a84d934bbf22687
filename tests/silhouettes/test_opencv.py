"""OpenCV's results on masks and photographs."""

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from pimper_torch.geometry.opencv import (
    BACKGROUND,
    OBJECT,
    PERHAPS_BACKGROUND,
    grab_cut_halved,
    signed_distance,
)
from pimper_torch.geometry.pixels import pixel_centers


def test_a_cut_at_half_resolution_has_an_error_below_two_pixels(generator):
    width, height = 121, 95  # odd: the last column and row cover half a pixel
    away = pixel_centers(width, height, like=torch.zeros(())) - torch.tensor([70.0, 40.0])
    disc = away.norm(dim=-1) < 30
    noise = torch.randint(0, 20, (height, width, 3), generator=generator)
    colours = (torch.where(disc[..., None], 180, 60) + noise).byte()
    labels = torch.full((height, width), PERHAPS_BACKGROUND, dtype=torch.uint8)
    labels[away.norm(dim=-1) < 8] = OBJECT
    labels[:4] = BACKGROUND
    cut = grab_cut_halved(colours, labels, 2)
    assert cut.shape == disc.shape
    assert not (cut != disc)[signed_distance(disc).abs() > 2].any()
    assert not cut[:4].any()


def test_distances_do_not_depend_on_the_memory_address_of_the_mask():
    """OpenCV's result differs in the last bit from call to call."""
    mask = torch.zeros(60, 80, dtype=torch.bool)
    mask[13:41, 22:57] = True
    inner, outer = (distance_transform_edt(side) for side in (mask, ~mask))
    exact = np.where(mask, inner - 0.5, 0.5 - outer).astype(np.float32)
    kept = []
    for extra in range(200):
        kept.append(np.empty(13 * extra + 1))  # so that the next call gets different addresses
        assert np.array_equal(signed_distance(mask).numpy(), exact)
