"""A sheet of markers as PDF, in vector graphics."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pimper_torch.scale.aruco import CELLS, cells_of
from pimper_torch.scale.sheet import PAPERS_MM, SIDE_MM, TITLE, Paper, layout

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_RULER_MM = 100
_HINT = (
    "Print at 100 %, not fitted to the page, and check that the ruler measures 100 mm.",
    "Lay the sheet flat, put the object on it, and photograph both.",
)


def write_sheet(path: Path | str, side_mm: int = SIDE_MM, paper: Paper = "a4") -> None:
    """Write a sheet of markers as PDF, to be printed and photographed with the object.

    It has AprilTags of the family 36h11 along the border, and a ruler of 100 mm in the middle to
    check the scale of the print. The same arguments give the same bytes.

    Args:
        side_mm: Side of the black squares, 10 to 36; encoded in the markers' numbers.
    """
    figure = draw_sheet(side_mm, paper)
    figure.savefig(path, format="pdf", metadata={"CreationDate": None, "Title": TITLE})


def draw_sheet(side_mm: int = SIDE_MM, paper: Paper = "a4") -> "Figure":
    """Draw a sheet of markers at its size.

    Args:
        side_mm: Side of the black squares, 10 to 36.
    """
    # Imported here so that importing the package does not load matplotlib; Figure without pyplot
    # leaves no global state.
    from matplotlib.figure import Figure

    width, height = PAPERS_MM[paper]
    figure = Figure(figsize=(width / 25.4, height / 25.4))
    axes: Any = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    for code, (left, top) in layout(side_mm, paper).items():
        _draw_marker(axes, code, left, top, side_mm)
    left, y = (width - _RULER_MM) / 2, height / 2
    for mark in range(0, _RULER_MM + 1):
        length = 6 if mark % 10 == 0 else 4 if mark % 5 == 0 else 2.5
        axes.plot([left + mark, left + mark], [y, y - length], color="black", linewidth=0.3)
        if mark % 10 == 0:
            axes.text(left + mark, y - 7, str(mark), ha="center", fontsize=7)
    axes.plot([left, left + _RULER_MM], [y, y], color="black", linewidth=0.3)
    axes.text(left + _RULER_MM / 2, y + 5, "100 mm", ha="center", fontsize=8)
    sentences = (*_HINT, f"pimper markers: sides of {side_mm} mm, AprilTag 36h11.")
    for line, text in enumerate(sentences):
        axes.text(width / 2, height / 2 + 14 + 5 * line, text, ha="center", fontsize=8)
    return figure


def _draw_marker(axes: Any, code: int, left: float, top: float, side: float) -> None:  # noqa: ANN401
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    squares = np.argwhere(cells_of(code).mT.numpy())[:, None] + corners  # of black cells
    # One path, because viewers show hairlines between shapes that only touch.
    outline = Outline.make_compound_path_from_polys(side / CELLS * squares + (left, top))
    axes.add_patch(PathPatch(outline, facecolor="black", linewidth=0))
