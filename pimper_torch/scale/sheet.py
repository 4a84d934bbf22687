"""Layout of a printed sheet of markers: codes, positions and size.

Codes encode the size: sheets with sides of 10, 11, ... 36 millimetres have 16 codes each, so that
photographs of a sheet are sufficient to determine its size.
"""

from typing import Literal

from pimper_torch.runtime.config import require

Paper = Literal["a4", "letter"]
"""Paper sizes of sheets."""

PAPERS_MM: dict[Paper, tuple[float, float]] = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}

TITLE = "pimper_torch sheet of markers"
"""Title of the PDF; it marks files that this package wrote."""

MIN_SIDE_MM, MAX_SIDE_MM, SIDE_MM = 10, 36, 30
_NUM_CODES = 16  # of a sheet: the border of a grid of 4 by 6
_ACROSS, _DOWN = 4, 6


def side_of(code: int) -> int | None:
    """Return the side in millimetres of the marker with this code; ``None`` if no sheet has it.

    >>> side_of(0), side_of(16 * 20 + 3), side_of(586)
    (10, 30, None)
    """
    side = MIN_SIDE_MM + code // _NUM_CODES
    return side if side <= MAX_SIDE_MM else None


def layout(side_mm: int = SIDE_MM, paper: Paper = "a4") -> dict[int, tuple[float, float]]:
    """Arrange markers along the border of a sheet; the object is in the middle.

    Returns:
        By code, the upper left corner of each black border, in millimetres from the left and upper
        edge of the sheet.
    """
    valid = MIN_SIDE_MM <= side_mm <= MAX_SIDE_MM
    require(valid, "side_mm", side_mm, f"{MIN_SIDE_MM} to {MAX_SIDE_MM} whole millimetres")
    columns, rows = (
        _evenly(extent, side_mm, most)
        for extent, most in zip(PAPERS_MM[paper], (_ACROSS, _DOWN), strict=True)
    )
    corners = [
        (left, top)
        for top in rows
        for left in columns
        if left in (columns[0], columns[-1]) or top in (rows[0], rows[-1])
    ]
    return dict(enumerate(corners, start=_NUM_CODES * (side_mm - MIN_SIDE_MM)))


def _evenly(extent_mm: float, side_mm: int, most: int) -> list[float]:
    """Return even positions of the squares that fit between the margins, at most ``most``."""
    margin, gap = 12.0, 8.0  # printers leave less than 6 mm blank; more than a cell of a marker
    between = extent_mm - 2 * margin
    count = min(most, int((between + gap) // (side_mm + gap)))
    step = (between - side_mm) / (count - 1)
    return [margin + index * step for index in range(count)]
