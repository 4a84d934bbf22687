"""A sheet of markers to print: which, where and how large.

Numbers encode the size: sheets with sides of 10, 11, ... 36 millimetres have 16 numbers each, so
that photographs of a sheet are enough to know its size.
"""

from typing import Literal

from pimper_torch.runtime.config import require

Paper = Literal["a4", "letter"]
"""Sizes of paper that sheets are made for."""

PAPERS_MM: dict[Paper, tuple[float, float]] = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}

TITLE = "pimper_torch sheet of markers"
"""Of the PDF; marks files that were written here."""

MIN_SIDE_MM, MAX_SIDE_MM, SIDE_MM = 10, 36, 30
_NUMBERS = 16  # of one sheet: a frame of 4 by 6
_ACROSS, _DOWN = 4, 6


def side_of(code: int) -> int | None:
    """Return the side of a sheet's marker in millimetres; ``None`` for one that is on no sheet.

    >>> side_of(0), side_of(16 * 20 + 3), side_of(586)
    (10, 30, None)
    """
    side = MIN_SIDE_MM + code // _NUMBERS
    return side if side <= MAX_SIDE_MM else None


def layout(side_mm: int = SIDE_MM, paper: Paper = "a4") -> dict[int, tuple[float, float]]:
    """Put markers along the border of a sheet; the object stands in the middle.

    Returns:
        By number, the upper left corner of each black border: millimetres from the sheet's left
        and upper edge.
    """
    sound = MIN_SIDE_MM <= side_mm <= MAX_SIDE_MM
    needed = f"{MIN_SIDE_MM} to {MAX_SIDE_MM} whole millimetres"
    require(sound, "side_mm", side_mm, needed)
    columns, rows = (
        _evenly(extent, side_mm, most)
        for extent, most in zip(PAPERS_MM[paper], (_ACROSS, _DOWN), strict=True)
    )
    places = [
        (left, top)
        for top in rows
        for left in columns
        if left in (columns[0], columns[-1]) or top in (rows[0], rows[-1])
    ]
    return dict(enumerate(places, start=_NUMBERS * (side_mm - MIN_SIDE_MM)))


def _evenly(extent_mm: float, side_mm: int, most: int) -> list[float]:
    """Spread as many squares as fit between the margins, ``most`` at most."""
    margin, gap = 12.0, 8.0  # printers leave less than 6 mm blank; more than a cell of a marker
    between = extent_mm - 2 * margin
    count = min(most, int((between + gap) // (side_mm + gap)))
    step = (between - side_mm) / (count - 1)
    return [margin + index * step for index in range(count)]
