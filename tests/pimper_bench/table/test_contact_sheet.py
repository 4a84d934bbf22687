import math

import numpy as np
import torch
from matplotlib import colormaps
from PIL import Image

from pimper_bench.table.contact_sheet import (
    MISSED,
    MethodPanels,
    SceneRow,
    crop_to,
    draw_sheet,
    error_picture,
)


def has_color(path, color):
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(float) / 255
    return bool((np.abs(pixels - np.array(color)).max(axis=-1) < 0.02).any())


def test_colours_saturate_at_the_clip():
    error = torch.tensor([[0.0, 0.5, 1.0, 50.0]])
    picture = error_picture(error)
    viridis = colormaps["viridis"]
    wanted = np.array([viridis(0.0), viridis(0.5), viridis(1.0), viridis(1.0)])[:, :3]
    np.testing.assert_allclose(picture[0], wanted, atol=1e-6)


def test_missed_and_empty_pixels_differ_from_errors_at_any_shading():
    error = torch.tensor([[math.inf, math.nan, 0.0]])
    picture = error_picture(error, torch.zeros(1, 3, 3))
    np.testing.assert_allclose(picture[0, 0], MISSED, atol=1e-6)
    np.testing.assert_allclose(picture[0, 1], 1.0, atol=1e-6)
    every = np.stack([colormaps["viridis"](x)[:3] for x in np.linspace(0, 1, 256)])
    for tint in (0.65, 1.0):  # zero error does not look like a missed pixel at any shading
        assert np.abs(tint * every - np.array(MISSED)).max(axis=1).min() > 0.2


def test_shading_darkens_a_colour_without_changing_its_hue():
    shading = torch.tensor([[[0.0] * 3, [1.0] * 3]])
    picture = error_picture(torch.tensor([[0.5, 0.5]]), shading)
    np.testing.assert_allclose(picture[0, 0], 0.65 * picture[0, 1], atol=1e-6)


def test_the_crop_contains_every_true_pixel_and_stays_inside():
    where = torch.zeros(40, 60, dtype=torch.bool)
    where[0, 10] = where[20, 30] = True
    rows, columns = crop_to(where)
    assert (rows.start, columns.start) == (0, 8)
    assert (rows.stop, columns.stop) == (23, 33)
    assert crop_to(torch.zeros(4, 5, dtype=torch.bool)) == (slice(None), slice(None))


def picture_of(color):
    return np.broadcast_to(np.array(color, dtype=np.float32), (30, 40, 3)).copy()


def test_the_sheet_has_every_image_or_the_reason_why_it_is_missing(tmp_path):
    colors = [(0.1, 0.2, 0.9), (0.9, 0.8, 0.1), (0.3, 0.9, 0.3), (0.9, 0.1, 0.9)]
    photograph, truth, surface, error = (picture_of(color) for color in colors)
    shown = MethodPanels(method="default", surface=surface, error=error)
    rows = [
        SceneRow(scene="mug", photograph=photograph, truth=truth, methods=(shown,)),
        SceneRow(
            scene="jar",
            photograph=photograph,
            truth=truth,
            methods=(MethodPanels(method="pmvs", note="not installed: pmvs2\nmore"),),
        ),
    ]
    draw_sheet(rows, tmp_path / "sheet.png")
    for color in (*colors, MISSED):
        assert has_color(tmp_path / "sheet.png", color)
    draw_sheet(rows[1:], tmp_path / "without.png")
    assert not has_color(tmp_path / "without.png", colors[2])
    with Image.open(tmp_path / "sheet.png") as two, Image.open(tmp_path / "without.png") as one:
        assert two.size[0] > one.size[0] + 200  # a column for the second method
        assert two.size[1] > 1.8 * one.size[1]
