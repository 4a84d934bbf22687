import numpy as np
import pytest
import torch

from pimper_torch.viz.tiles import Tile, encoded, fitted, sheet, with_triangles


def plain(color, height=30, width=40):
    return np.broadcast_to(np.array(color, dtype=np.float32), (height, width, 3)).copy()


def places(page, color):
    """Return the rows and columns of a colour, if any."""
    pixels = np.asarray(page).astype(float) / 255
    rows, columns = np.nonzero(np.abs(pixels - np.array(color)).max(axis=-1) < 0.01)
    return (rows.min(), rows.max() + 1, columns.min(), columns.max() + 1) if len(rows) else None


def test_rows_of_tiles_have_the_height_of_their_tallest():
    red, green, blue = (0.8, 0, 0), (0, 0.8, 0), (0, 0, 0.8)
    rows = [
        [Tile(title="a", picture=plain(red, 60)), Tile(title="b", picture=plain(green))],
        [Tile(picture=plain(blue))],
    ]
    page = sheet(rows, 40)
    (top, bottom, left, right), second, third = (places(page, one) for one in (red, green, blue))
    assert (bottom - top, right - left) == (60, 40)
    assert second[0] == top
    assert second[1] == top + 30
    assert second[2] > right
    assert third[0] >= bottom
    assert third[2] == left
    assert page.height - third[1] < 30


def test_a_wide_tile_has_the_sheets_width_and_a_tall_one_is_narrower():
    rows = [
        [Tile(picture=plain((0.8, 0, 0))), Tile(picture=plain((0, 0.8, 0), 400, 40))],
        [Tile(picture=plain((0, 0, 0.8), 5, 80), wide=True)],
    ]
    page = sheet(rows, 40)
    tall, wide = places(page, (0, 0.8, 0)), places(page, (0, 0, 0.8))
    assert tall[1] - tall[0] == 64
    assert abs((tall[1] - tall[0]) - 10 * (tall[3] - tall[2])) < 10
    assert (wide[2], page.width - wide[3]) == (10, 10)


def test_a_headline_and_a_note_are_written():
    bare = sheet([[Tile()]], 80)
    noted = sheet([[Tile(note="not installed: pmvs2\nmore")]], 80)
    assert (np.asarray(bare) == 255).all()
    assert (np.asarray(noted) < 200).any()
    assert sheet([[Tile()]], 80, "3 photographs").height > bare.height


def test_images_are_scaled_to_their_tile_unless_they_fit():
    picture = plain((0.2, 0.4, 0.6))
    assert fitted(picture, 40) is picture
    assert fitted(picture, 80).shape == (60, 80, 3)
    np.testing.assert_allclose(fitted(picture, 20), plain((0.2, 0.4, 0.6), 15, 20), atol=1 / 255)


def test_triangles_are_drawn_along_their_sides():
    corners = torch.tensor([[[5.0, 5.0], [35.0, 5.0], [5.0, 25.0]]])
    drawn = with_triangles(plain((0, 0, 0)), corners, "#ff0000")
    assert drawn[5, 20, 0] > 0.3
    assert drawn[15, 5, 0] > 0.3
    assert drawn[12, 12].max() == 0  # inside
    assert drawn[28, 38].max() == 0


def test_radiance_is_encoded_and_grey_has_three_channels():
    picture = encoded(torch.full((2, 3, 1), 0.2140))
    assert picture.shape == (2, 3, 3)
    np.testing.assert_allclose(picture, 0.5, atol=1e-3)
    assert encoded(torch.full((1, 1, 3), 7.0)).max() == pytest.approx(1)
