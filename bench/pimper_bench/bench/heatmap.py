"""Errors on the surface, and the contact sheet of the bench.

An error map has one number a pixel: finite where it was measured, infinite where the truth
shows something that the surface misses, NaN where there is nothing to compare.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.ground.geometry.rigid import rotate
from pimper_torch.ground.geometry.visibility import Hits
from pimper_torch.records import Cameras, Mesh
from pimper_torch.result.viz.maps import normal_colors, view_maps
from pimper_torch.result.viz.render import shade
from pimper_torch.result.viz.tiles import Picture, Tile, array, sheet
from pimper_torch.runtime.errors import InputError

_COLORS = "viridis"  # perceptually uniform, and it has no red
MISSED = (0.88, 0.20, 0.16)
_PANEL_PX, _HEATMAP_PX = 260, 620
_BAR_PX = (16, 400)


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorScale:
    """Scale from errors to colours.

    Attributes:
        clip: Errors from here on have the last colour.
        unit: Of the errors, such as ``% of the diagonal``.
    """

    clip: float
    unit: str
    what: str = "distance to the truth"

    def __post_init__(self) -> None:
        if not (self.clip > 0 and np.isfinite(self.clip)):
            raise InputError(f"clip is {self.clip}; needed: a finite number above 0.")

    @property
    def label(self) -> str:
        """Title of the colour bar."""
        return f"{self.what}, {self.unit}, 0 to {self.clip:g} (clipped at {self.clip:g})"


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodPanels:
    """Result of one method on a scene.

    Attributes:
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
        photograph: sRGB, rows first, as large as the pictures below.
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
        colors = colors * (0.65 + 0.35 * tone)  # darker would hide the colour
    colors[values.isnan().numpy()] = 1
    colors[values.isinf().numpy()] = MISSED
    return np.asarray(colors, dtype=np.float32)


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
        hits: Of the view's rays on the mesh, if they are known already.
    """
    if not len(mesh.faces):
        width, height = (int(side) for side in cameras.sizes_px[view])
        return np.ones((height, width, 3), dtype=np.float32)
    return _on_white(view_maps(mesh, cameras, view, hits).normals_cam)


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
        room = round(0.04 * (high - low)) + 1
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
        shading: The surface in that view, see :func:`shading_in_view`.
    """
    rows, columns = crop_to(~error.isnan())
    picture = error_picture(error, scale, shading=shading)[rows, columns]
    shown = [[Tile(title=title, picture=picture)], [_bar(scale, missed=bool(error.isinf().any()))]]
    sheet(shown, _HEATMAP_PX).save(path)


def draw_sheet(rows: Sequence[SceneRow], scale: ErrorScale, path: Path | str) -> None:
    """Draw scenes by methods as PNG.

    Every scene has two rows of pictures: the photograph and each method's surface above, the
    true normals and each method's errors below. A method has one column in all scenes.

    Args:
        rows: At least one; a method that is missing in one leaves its place empty there.
    """
    if not rows:
        raise InputError("there is no scene to draw; needed: one or more.")
    names = tuple(dict.fromkeys(panels.method for row in rows for panels in row.methods))
    shown: list[list[Tile]] = []
    for row in rows:
        of_method = {panels.method: panels for panels in row.methods}
        methods = [of_method.get(name, MethodPanels(method=name)) for name in names]
        above = [Tile(title=f"{row.scene}, photograph", picture=row.photograph)]
        below = [Tile(title="true normals", picture=row.truth)]
        for one in methods:
            above.append(Tile(title=one.method, picture=one.surface, note=one.note))
            note = "" if one.surface is None else one.note  # once is enough
            below.append(Tile(picture=one.error, note=note))
        shown += [above, below]
    sheet([*shown, [_bar(scale, missed=True)]], _PANEL_PX).save(path)


def _on_white(normals_cam: Float[Tensor, "height width 3"]) -> Picture:
    there = (normals_cam != 0).any(dim=-1, keepdim=True)
    return array(torch.where(there, normal_colors(normals_cam), 1.0))


def _bar(scale: ErrorScale, *, missed: bool) -> Tile:
    """Draw the colours of a scale in a row, and what red means."""
    height, width = _BAR_PX
    values = torch.linspace(0, scale.clip, width).expand(height, width).clone()
    if missed:
        values[:, -width // 10 :] = torch.inf
    title = f"{scale.label}{'; red: missed' if missed else ''}"
    return Tile(title=title, picture=error_picture(values, scale), wide=True)
