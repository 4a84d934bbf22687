import math

import numpy as np
import pytest
import torch
from matplotlib import colormaps
from PIL import Image
from scenes import from_above, tilted_square

from pimper_bench.bench.heatmap import (
    MISSED,
    ErrorScale,
    MethodPanels,
    SceneRow,
    crop_to,
    draw_heatmap,
    draw_sheet,
    error_picture,
    normals_picture,
    shading_in_view,
    surface_picture,
)
from pimper_torch.runtime.errors import InputError

SCALE = ErrorScale(clip=2.0, unit="% of the diagonal")


@pytest.fixture
def plane():
    return tilted_square()


@pytest.fixture
def front():
    return from_above(60.0, 48, 36)


def has_color(path, color):
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(float) / 255
    return bool((np.abs(pixels - np.array(color)).max(axis=-1) < 0.02).any())


def test_colours_run_from_no_error_to_the_clip_and_stay_there():
    error = torch.tensor([[0.0, 1.0, 2.0, 50.0]])
    picture = error_picture(error, SCALE)
    viridis = colormaps["viridis"]
    wanted = np.array([viridis(0.0), viridis(0.5), viridis(1.0), viridis(1.0)])[:, :3]
    np.testing.assert_allclose(picture[0], wanted, atol=1e-6)


def test_missed_and_empty_pixels_are_told_from_errors_whatever_the_shading():
    error = torch.tensor([[math.inf, math.nan, 0.0]])
    picture = error_picture(error, SCALE, shading=torch.zeros(1, 3, 3))
    np.testing.assert_allclose(picture[0, 0], MISSED, atol=1e-6)
    np.testing.assert_allclose(picture[0, 1], 1.0, atol=1e-6)
    every = np.stack([colormaps["viridis"](x)[:3] for x in np.linspace(0, 1, 256)])
    for tint in (0.65, 1.0):  # no error, however shaded, looks like a missed pixel
        assert np.abs(tint * every - np.array(MISSED)).max(axis=1).min() > 0.2


def test_shading_darkens_a_colour_without_changing_its_hue():
    shading = torch.tensor([[[0.0] * 3, [1.0] * 3]])
    picture = error_picture(torch.tensor([[1.0, 1.0]]), SCALE, shading=shading)
    np.testing.assert_allclose(picture[0, 0], 0.65 * picture[0, 1], atol=1e-6)


def test_points_without_faces_are_drawn_as_nothing(plane, front, tmp_path):
    points = plane.replace(faces=torch.zeros(0, 3, dtype=torch.long))
    assert shading_in_view(points, front, 0) is None
    assert (surface_picture(points, front, 0) == 1).all()
    error = torch.full((36, 48), torch.inf)
    draw_heatmap(error, SCALE, tmp_path / "map.png")
    assert has_color(tmp_path / "map.png", MISSED)


def test_normals_are_coloured_in_the_cameras_frame(plane, front):
    towards = torch.zeros(36, 48, 3)
    towards[5, 6, 2] = 1.0  # world z is where the camera stands
    picture = normals_picture(towards, front, 0)
    np.testing.assert_allclose(picture[5, 6], [0.5, 0.5, 1.0], atol=1e-6)
    assert (picture[0, 0] == 1).all()
    np.testing.assert_allclose(surface_picture(plane, front, 0)[18, 24], [0.5, 0.5, 1], atol=1e-5)


def test_the_crop_holds_every_true_pixel_and_stays_inside():
    where = torch.zeros(40, 60, dtype=torch.bool)
    where[0, 10] = where[20, 30] = True
    rows, columns = crop_to(where)
    assert (rows.start, columns.start) == (0, 8)
    assert (rows.stop, columns.stop) == (23, 33)
    assert crop_to(torch.zeros(4, 5, dtype=torch.bool)) == (slice(None), slice(None))


def test_a_heat_map_is_drawn_with_what_is_missed(plane, front, tmp_path):
    error = torch.zeros(36, 48)
    shading = shading_in_view(plane, front, 0)
    draw_heatmap(error, SCALE, tmp_path / "whole.png", shading=shading, title="mug, default")
    assert not has_color(tmp_path / "whole.png", MISSED)
    error[10:20, 20:30] = torch.inf
    draw_heatmap(error, SCALE, tmp_path / "missed.png", shading=shading)
    assert has_color(tmp_path / "missed.png", MISSED)


def picture_of(color):
    return np.broadcast_to(np.array(color, dtype=np.float32), (30, 40, 3)).copy()


def test_the_sheet_holds_every_picture_and_says_why_one_is_missing(tmp_path):
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
    draw_sheet(rows, SCALE, tmp_path / "sheet.png")
    for color in (*colors, MISSED):
        assert has_color(tmp_path / "sheet.png", color)
    draw_sheet(rows[1:], SCALE, tmp_path / "without.png")
    assert not has_color(tmp_path / "without.png", colors[2])
    with Image.open(tmp_path / "sheet.png") as two, Image.open(tmp_path / "without.png") as one:
        assert two.size[0] > one.size[0] + 200  # a column for the second method
        assert two.size[1] > 1.8 * one.size[1]


def test_impossible_scales_and_empty_sheets_are_refused(tmp_path):
    for clip in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(InputError, match="clip"):
            ErrorScale(clip=clip, unit="mm")
    with pytest.raises(InputError, match="no scene"):
        draw_sheet([], SCALE, tmp_path / "sheet.png")
    assert "clipped at 2" in SCALE.label
    assert "% of the diagonal" in SCALE.label
