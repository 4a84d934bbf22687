"""Errors on the surface, and the contact sheet of the bench.

An error map has one number a pixel: finite where it was measured, infinite where the truth
shows something that the surface misses, NaN where there is nothing to compare.
"""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.geometry.frames import rotate
from pimper_torch.geometry.visibility import Hits
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records import Cameras, Mesh
from pimper_torch.viz.maps import normal_colors, view_maps
from pimper_torch.viz.render import shade

Picture = np.ndarray[tuple[int, ...], np.dtype[np.float32]]

_COLORS = "viridis"  # perceptually uniform, and it has no red
MISSED = (0.88, 0.20, 0.16)
_DARKEST = 0.65  # shading of the steepest height field; darker would hide the colour it tints
_MARGIN = 0.04
# Inches: width of a panel, room between panels, a title, names at the left, the colour bar.
_PANEL_IN, _GAP_IN, _TITLE_IN, _NAME_IN, _BAR_IN = 2.6, 0.08, 0.32, 0.3, 0.95
_NOTE_WIDTH = 38  # letters across a panel


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorScale:
    """How errors become colours.

    Attributes:
        clip: Errors from here on have the last colour.
        unit: Of the errors, such as ``% of the diagonal``.
        what: Is in error.
    """

    clip: float
    unit: str
    what: str = "distance to the truth"

    def __post_init__(self) -> None:
        if not (self.clip > 0 and np.isfinite(self.clip)):
            raise InputError(f"clip is {self.clip}; needed: a finite number above 0.")

    @property
    def label(self) -> str:
        """What stands beside the colour bar."""
        return f"{self.what}, {self.unit} (clipped at {self.clip:g})"


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodPanels:
    """What one method made of a scene.

    Attributes:
        method: Name.
        surface: Picture of it, sRGB, rows first; ``None`` if it gave none.
        error: Picture of its error map; ``None`` if there is none.
        note: Stands where pictures are missing.
    """

    method: str
    surface: Picture | None = None
    error: Picture | None = None
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneRow:
    """A scene on the sheet: the truth, then one column a method.

    Attributes:
        scene: Name.
        photograph: sRGB, rows first, as large as the pictures below.
        truth: Picture of the true normals.
        methods: Those that were run.
    """

    scene: str
    photograph: Picture
    truth: Picture
    methods: tuple[MethodPanels, ...]


def error_picture(
    error: Float[Tensor, "height width"],
    scale: ErrorScale,
    *,
    shading: Float[Tensor, "height width 3"] | None = None,
) -> Picture:
    """Colour an error map.

    Args:
        error: See the head of this file.
        scale: From the first colour at 0 to the last at its clip.
        shading: The surface, shaded; tints the colours a little so that height field is seen.

    Returns:
        sRGB. Missed pixels are red, whatever the shading; white where there is nothing.
    """
    from matplotlib import colormaps

    values = error.detach().cpu().double()
    colors = colormaps[_COLORS]((values / scale.clip).clamp(0, 1).nan_to_num(0).numpy())[..., :3]
    if shading is not None:
        tone = shading.detach().cpu().double().mean(dim=-1, keepdim=True).numpy()
        colors = colors * (_DARKEST + (1 - _DARKEST) * tone)
    colors[values.isnan().numpy()] = 1
    colors[values.isinf().numpy()] = MISSED
    picture: Picture = colors.astype(np.float32)
    return picture


def shading_in_view(
    mesh: Mesh, cameras: Cameras, view: int
) -> Float[Tensor, "height width 3"] | None:
    """Shade a mesh as one camera sees it; ``None`` for points without faces."""
    return shade(mesh, cameras.take([view])) if len(mesh.faces) else None


def normals_picture(
    normals_world: Float[Tensor, "height width 3"], cameras: Cameras, view: int
) -> Picture:
    """Colour normals in the frame of a camera; white where there are none."""
    normals_cam = rotate(cameras.cam_from_world[view].to(normals_world), normals_world)
    return _on_white(normals_cam)


def surface_picture(mesh: Mesh, cameras: Cameras, view: int, hits: Hits | None = None) -> Picture:
    """Colour the normals that a mesh carries, or those of its shape if it carries none.

    Args:
        mesh: Any; points without faces give a white picture.
        cameras: Its world.
        hits: Of the view's rays on the mesh, if they are known already.
    """
    if not len(mesh.faces):
        width, height = (int(side) for side in cameras.sizes_px[view])
        return np.ones((height, width, 3), dtype=np.float32)
    return _on_white(view_maps(mesh, cameras, view, hits).normals_cam)


def photograph_picture(radiance: Float[Tensor, "channel height width"]) -> Picture:
    """Encode a photograph for the screen."""
    encoded = srgb_from_linear(radiance.detach().clamp(0, 1)).expand(3, -1, -1)
    picture: Picture = encoded.movedim(0, -1).cpu().float().numpy()
    return picture


def crop_to(where: Bool[Tensor, "height width"]) -> tuple[slice, slice]:
    """Return the rows and columns that hold all true pixels, with a little room.

    Everything where none is true.
    """
    if not bool(where.any()):
        return slice(None), slice(None)
    spans = []
    for axis, size in ((1, where.shape[0]), (0, where.shape[1])):
        there = torch.nonzero(where.any(dim=axis))[:, 0]
        low, high = int(there[0]), int(there[-1]) + 1
        room = round(_MARGIN * (high - low)) + 1
        spans.append(slice(max(0, low - room), min(size, high + room)))
    return spans[0], spans[1]


def draw_heatmap(
    error: Float[Tensor, "height width"],
    scale: ErrorScale,
    path: Path | str,
    *,
    shading: Float[Tensor, "height width 3"] | None = None,
    title: str = "",
) -> None:
    """Draw one error map on the shaded surface, with its colour bar, as PNG.

    Args:
        error: Of every pixel of a view, see the head of this file.
        scale: Colours and their unit.
        path: Ends in ``.png``.
        shading: The surface in that view, see :func:`shading_in_view`.
    """
    path = Path(path)
    picture = error_picture(error, scale, shading=shading)
    rows, columns = crop_to(~error.isnan())
    cropped = picture[rows, columns]
    tall = 2 * _PANEL_IN * cropped.shape[0] / cropped.shape[1]
    size = (2 * _PANEL_IN + 2 * _GAP_IN + _BAR_IN, max(tall, _PANEL_IN) + _TITLE_IN + _GAP_IN)
    figure = _figure(size)
    box = (_GAP_IN, _GAP_IN, 2 * _PANEL_IN, size[1] - _TITLE_IN - _GAP_IN)
    _show(figure, size, box, cropped, title=title)
    _bar(figure, size, scale, missed=bool(error.isinf().any()))
    figure.savefig(path, dpi=120, facecolor="white")


def draw_sheet(rows: Sequence[SceneRow], scale: ErrorScale, path: Path | str) -> None:
    """Draw scenes by methods as PNG.

    Every scene has two rows of pictures: the photograph and each method's surface above, the
    true normals and each method's errors below. A method has one column in all scenes.

    Args:
        rows: At least one; a method that is missing in one leaves its place empty there.
        path: Ends in ``.png``.

    Raises:
        InputError: There are no rows.
    """
    path = Path(path)
    if not rows:
        raise InputError("there is no scene to draw; needed: one or more.")
    names = tuple(dict.fromkeys(panels.method for row in rows for panels in row.methods))
    heights = [_PANEL_IN * row.photograph.shape[0] / row.photograph.shape[1] for row in rows]
    width = _NAME_IN + (1 + len(names)) * (_PANEL_IN + _GAP_IN) + _BAR_IN
    size = (width, _TITLE_IN + sum(2 * (height + _GAP_IN) for height in heights))
    figure = _figure(size)
    top = size[1] - _TITLE_IN
    for index, name in enumerate(("photograph, true normals", *names)):
        x = _NAME_IN + index * (_PANEL_IN + _GAP_IN) + _PANEL_IN / 2
        figure.text(x / size[0], (top + 0.1) / size[1], name, ha="center", fontsize=10)
    for row, height in zip(rows, heights, strict=True):
        centre = (top - height - _GAP_IN / 2) / size[1]
        figure.text(
            0.12 / size[0], centre, row.scene, rotation=90, va="center", ha="center", fontsize=11
        )
        for index, panels in enumerate(_columns(row, names)):
            left = _NAME_IN + index * (_PANEL_IN + _GAP_IN)
            again = "" if panels.surface is None else panels.note  # once is enough
            for picture, bottom, note in (
                (panels.surface, top - height, panels.note),
                (panels.error, top - 2 * height - _GAP_IN, again),
            ):
                _show(figure, size, (left, bottom, _PANEL_IN, height), picture, note=note)
        top -= 2 * (height + _GAP_IN)
    _bar(figure, size, scale, missed=True)
    figure.savefig(path, dpi=100, facecolor="white")


def _columns(row: SceneRow, names: Sequence[str]) -> list[MethodPanels]:
    """Return a scene's pictures column by column: the truth, then every method of the sheet."""
    truth = MethodPanels(method="truth", surface=row.photograph, error=row.truth)
    of_method = {panels.method: panels for panels in row.methods}
    return [truth, *(of_method.get(name, MethodPanels(method=name)) for name in names)]


def _on_white(normals_cam: Float[Tensor, "height width 3"]) -> Picture:
    there = (normals_cam != 0).any(dim=-1, keepdim=True)
    colors = torch.where(there, normal_colors(normals_cam), 1.0)
    picture: Picture = colors.detach().cpu().float().numpy()
    return picture


def _figure(size: tuple[float, float]) -> Any:  # noqa: ANN401 - matplotlib is not loaded yet
    # Figure without pyplot leaves no global state behind.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
    return figure


def _show(
    figure: Any,  # noqa: ANN401 - see _figure
    size: tuple[float, float],
    box: tuple[float, float, float, float],
    picture: Picture | None,
    *,
    title: str = "",
    note: str = "",
) -> None:
    """Put a picture, or the note on why there is none, in a box of inches from bottom left."""
    left, bottom, width, height = box
    axes = figure.add_axes(
        (left / size[0], bottom / size[1], width / size[0], height / size[1]),
    )
    axes.set_axis_off()
    axes.set_title(title, fontsize=10)
    if picture is not None:
        axes.imshow(picture, interpolation="antialiased")
        return
    first = (note.strip().splitlines() or [""])[0]
    words = textwrap.fill(first, _NOTE_WIDTH, max_lines=4, placeholder=" …")
    axes.text(0.5, 0.5, words, ha="center", va="center", fontsize=8, color="0.4")


def _bar(
    figure: Any,  # noqa: ANN401 - see _figure
    size: tuple[float, float],
    scale: ErrorScale,
    *,
    missed: bool,
) -> None:
    """Draw the colour bar at the right, and what red means below it."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.patches import Rectangle

    tall = min(size[1] - 2 * _TITLE_IN, 4.0)
    left, bottom = size[0] - _BAR_IN + 0.15, (size[1] - tall) / 2
    axes = figure.add_axes((left / size[0], bottom / size[1], 0.15 / size[0], tall / size[1]))
    shown = ScalarMappable(norm=Normalize(0, scale.clip), cmap=_COLORS)
    bar = figure.colorbar(shown, cax=axes, extend="max")
    bar.set_label(scale.label, fontsize=8)
    bar.ax.tick_params(labelsize=8)
    if missed:
        y = bottom - 0.22
        figure.add_artist(
            Rectangle(
                (left / size[0], y / size[1]),
                0.15 / size[0],
                0.12 / size[1],
                color=MISSED,
                transform=figure.transFigure,
            )
        )
        figure.text((left + 0.2) / size[0], y / size[1], "missed", fontsize=8)
