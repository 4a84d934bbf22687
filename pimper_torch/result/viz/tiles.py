"""Sheets of pictures: rows of tiles with titles, on white."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from pimper_torch.ground.radiometry import srgb_from_linear
from pimper_torch.ground.shapes import Scalars

Picture = np.ndarray[tuple[int, ...], np.dtype[np.float32]]

# Choices, for a sheet of four tiles of 390 pixels.
_GAP_PX, _TITLE_PX, _HEADLINE_PX = 10, 26, 36
_TEXT_PX, _LARGE_PX, _SMALL_PX = 15, 18, 11
TALLEST = 1.6  # a picture that is higher for its width is shown narrower


@dataclass(frozen=True, slots=True, kw_only=True)
class Tile:
    """A picture of a sheet.

    Attributes:
        picture: sRGB in [0, 1], rows first; ``None`` where there is none.
        note: Written in place of a missing picture.
        wide: Takes a row of its own, as wide as the sheet.
    """

    title: str = ""
    picture: Picture | None = None
    note: str = ""
    wide: bool = False


def sheet(rows: Sequence[Sequence[Tile]], tile_px: int, headline: str = "") -> Image.Image:
    """Lay tiles out in rows as high as their highest."""
    across = max(len(row) for row in rows)
    width = across * (tile_px + _GAP_PX) + _GAP_PX
    placed, top = [], _HEADLINE_PX if headline else _GAP_PX
    for row in rows:
        room = width - 2 * _GAP_PX if row[0].wide else tile_px
        top += _TITLE_PX if any(tile.title for tile in row) else 0
        pictures = [
            None if one.picture is None else _image(fitted(one.picture, room)) for one in row
        ]
        placed.append((top, room, row, pictures))
        top += max([one.height for one in pictures if one is not None], default=tile_px)
        top += _GAP_PX
    page = Image.new("RGB", (width, top), "white")
    draw = ImageDraw.Draw(page)
    large, usual, small = map(ImageFont.load_default, (_LARGE_PX, _TEXT_PX, _SMALL_PX))
    draw.text((width / 2, _HEADLINE_PX / 2), headline, "black", large, anchor="mm")
    for top, room, row, pictures in placed:
        for column, (tile, picture) in enumerate(zip(row, pictures, strict=True)):
            left = _GAP_PX + column * (tile_px + _GAP_PX)
            above = (left + room / 2, top - _TITLE_PX / 2)
            draw.text(above, tile.title, "black", usual, anchor="mm")
            if picture is not None:
                page.paste(picture, (left + (room - picture.width) // 2, top))
            elif tile.note:
                words = textwrap.fill(tile.note, room // 8, max_lines=4, placeholder=" …")
                at = (left + room / 2, top + room / 4)
                draw.text(at, words, "gray", small, anchor="mm", align="center")
    return page


def fitted(picture: Picture, room_px: int) -> Picture:
    """Scale a picture to the width of a tile, or narrower where it is tall."""
    height, width = picture.shape[:2]
    wide = min(room_px, room_px * TALLEST * width / height)
    size = (max(1, round(wide)), max(1, round(wide * height / width)))
    if size == (width, height):
        return picture
    return _picture(_image(picture).resize(size, Image.Resampling.LANCZOS))


def with_triangles(picture: Picture, corners: Float[Tensor, "face 3 2"], color: str) -> Picture:
    """Draw the sides of triangles over a picture."""
    large = _image(picture)
    large = large.resize((2 * large.width, 2 * large.height))  # lines are smooth
    draw = ImageDraw.Draw(large)
    for triangle in (2 * corners).tolist():
        draw.line([tuple(corner) for corner in (*triangle, triangle[0])], color)
    return _picture(large.reduce(2))


def encoded(radiance: Float[Tensor, "height width channel"]) -> Picture:
    """Encode linear radiance for the screen, cut off at 1; grey has three equal channels."""
    return array(srgb_from_linear(radiance.detach().clamp(0, 1)).expand(-1, -1, 3))


def array(values: Scalars) -> Picture:
    """Return values as single precision on the CPU."""
    return values.detach().cpu().float().numpy()


def _image(picture: Picture) -> Image.Image:
    return Image.fromarray((255 * picture.clip(0, 1)).round().astype(np.uint8))


def _picture(image: Image.Image) -> Picture:
    return np.asarray(image, dtype=np.float32) / np.float32(255)
