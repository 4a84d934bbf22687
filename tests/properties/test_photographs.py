"""Photographs stored rotated, with EXIF orientation, are read upright."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from pimper_torch.io.photographs import load_views

# EXIF orientation, and the stored pixels that it makes upright.
STORED = {
    1: lambda pixels: pixels,
    2: lambda pixels: pixels[:, ::-1],
    3: lambda pixels: pixels[::-1, ::-1],
    4: lambda pixels: pixels[::-1],
    5: lambda pixels: pixels.swapaxes(0, 1),
    6: lambda pixels: np.rot90(pixels, 1),
    7: lambda pixels: pixels[::-1, ::-1].swapaxes(0, 1),
    8: lambda pixels: np.rot90(pixels, -1),
}


@settings(max_examples=25, deadline=None)
@given(
    orientations=st.lists(st.sampled_from(sorted(STORED)), min_size=3, max_size=3),
    wide=st.integers(4, 40),
    high=st.integers(4, 40),
    seed=st.integers(0, 2**31 - 1),
)
def test_exif_orientation_does_not_change_the_views(
    tmp_path_factory, orientations, wide, high, seed
):
    folder = tmp_path_factory.mktemp("turned")
    pixels = np.random.default_rng(seed).integers(20, 236, (3, high, wide, 3), dtype=np.uint8)
    for number, (orientation, upright) in enumerate(zip(orientations, pixels, strict=True)):
        exif = Image.Exif()
        exif[0x0112] = orientation
        stored = np.ascontiguousarray(STORED[orientation](upright))
        Image.fromarray(stored).save(folder / f"{number}.png", exif=exif)
    upright = tmp_path_factory.mktemp("upright")
    for number, image in enumerate(pixels):
        Image.fromarray(image).save(upright / f"{number}.png")
    found, wanted = load_views(folder), load_views(upright)
    assert torch.equal(found.images, wanted.images)
    assert torch.equal(found.sizes_px, wanted.sizes_px)
