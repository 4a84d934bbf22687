"""Sheets of images: rows of tiles with titles, on white."""

import base64
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Literal

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records.shapes import Scalars

Picture = np.ndarray[tuple[int, ...], np.dtype[np.float32]]

# Choices, for a sheet of four tiles of 390 pixels.
_GAP_PX, _TITLE_PX, _HEADLINE_PX = 10, 26, 36
_TEXT_PX, _LARGE_PX, _SMALL_PX = 15, 18, 11
TALLEST = 1.6  # maximum ratio of height to width; taller images are shown narrower


@dataclass(frozen=True, slots=True, kw_only=True)
class Tile:
    """An image of a sheet.

    Attributes:
        picture: sRGB in [0, 1], rows first; ``None`` for a missing image.
        note: Text instead of a missing image.
        wide: Whether it has a separate row, as wide as the sheet.
    """

    title: str = ""
    picture: Picture | None = None
    note: str = ""
    wide: bool = False


def sheet(rows: Sequence[Sequence[Tile]], tile_px: int, headline: str = "") -> Image.Image:
    """Arrange tiles in rows; a row is as high as its highest tile."""
    across = max(len(row) for row in rows)
    width = across * (tile_px + _GAP_PX) + _GAP_PX
    placed, top = [], _HEADLINE_PX if headline else _GAP_PX
    for row in rows:
        space = width - 2 * _GAP_PX if row[0].wide else tile_px
        top += _TITLE_PX if any(tile.title for tile in row) else 0
        images = [
            None if tile.picture is None else image_of(fitted(tile.picture, space)) for tile in row
        ]
        placed.append((top, space, row, images))
        top += max([image.height for image in images if image is not None], default=tile_px)
        top += _GAP_PX
    page = Image.new("RGB", (width, top), "white")
    draw = ImageDraw.Draw(page)
    large, usual, small = map(ImageFont.load_default, (_LARGE_PX, _TEXT_PX, _SMALL_PX))
    draw.text((width / 2, _HEADLINE_PX / 2), headline, "black", large, anchor="mm")
    for top, space, row, images in placed:
        for column, (tile, image) in enumerate(zip(row, images, strict=True)):
            left = _GAP_PX + column * (tile_px + _GAP_PX)
            above = (left + space / 2, top - _TITLE_PX / 2)
            draw.text(above, tile.title, "black", usual, anchor="mm")
            if image is not None:
                page.paste(image, (left + (space - image.width) // 2, top))
            elif tile.note:
                words = textwrap.fill(tile.note, space // 8, max_lines=4, placeholder=" …")
                position = (left + space / 2, top + space / 4)
                draw.text(position, words, "gray", small, anchor="mm", align="center")
    return page


def fitted(picture: Picture, width_px: int) -> Picture:
    """Scale an image to the width of a tile, or less if it is tall."""
    height, width = picture.shape[:2]
    wide = min(width_px, width_px * TALLEST * width / height)
    size = (max(1, round(wide)), max(1, round(wide * height / width)))
    if size == (width, height):
        return picture
    return _picture(image_of(picture).resize(size, Image.Resampling.LANCZOS))


def with_triangles(picture: Picture, corners: Float[Tensor, "face 3 2"], color: str) -> Picture:
    """Draw the edges of triangles over an image."""
    large = image_of(picture)
    large = large.resize((2 * large.width, 2 * large.height))  # for smooth lines
    draw = ImageDraw.Draw(large)
    for triangle in (2 * corners).tolist():
        draw.line([tuple(corner) for corner in (*triangle, triangle[0])], color)
    return _picture(large.reduce(2))


def encoded(radiance: Float[Tensor, "height width channel"]) -> Picture:
    """Encode linear radiance as sRGB, clipped at 1; grey gets three equal channels."""
    return array(srgb_from_linear(radiance.detach().clamp(0, 1)).expand(-1, -1, 3))


def array(values: Scalars) -> Picture:
    """Return values in single precision on the CPU."""
    return values.detach().cpu().float().numpy()


def image_of(picture: Picture) -> Image.Image:
    """Return a picture with 8 bits."""
    return Image.fromarray((255 * picture.clip(0, 1)).round().astype(np.uint8))


def data_url(image: Image.Image, kind: Literal["JPEG", "PNG"] = "JPEG") -> str:
    """Return an image as the URL of its file, for HTML."""
    file = BytesIO()
    image.save(file, kind, quality=80)  # of JPEG
    return f"data:image/{kind.lower()};base64,{base64.b64encode(file.getvalue()).decode('ascii')}"


def _picture(image: Image.Image) -> Picture:
    return np.asarray(image, dtype=np.float32) / np.float32(255)
