"""Errors on the surface, and the contact sheet of the bench.

An error map has one number a pixel, per cent of the diagonal of the true bounding box: finite
where it was measured, infinite where the truth shows something that the surface misses, NaN where
there is nothing to compare.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_bench.bench.bench_inputs import Inputs
from pimper_bench.metrics.in_view import Meeting
from pimper_bench.metrics.surface_distances import bounding_diagonal
from pimper_bench.truth import Capture
from pimper_torch.ground.geometry.rigid import rotate
from pimper_torch.records import Mesh
from pimper_torch.result.viz.maps import normal_colors, view_maps
from pimper_torch.result.viz.render import shade
from pimper_torch.result.viz.tiles import Picture, Tile, array, encoded, sheet

_COLORS = "viridis"  # perceptually uniform, and it has no red
MISSED = (0.88, 0.20, 0.16)
# Errors from here on have the last colour: twice what the facets alone are off by, so that
# methods differ.
CLIP_PERCENT = 1.0
LABEL = f"distance to the truth, % of the diagonal, 0 to {CLIP_PERCENT:g} (clipped there)"
_PANEL_PX = 400
_BAR_PX = (16, 400)


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


def method_panels(mesh: Mesh, met: Meeting | None, inputs: Inputs, method: str) -> MethodPanels:
    """Draw a surface and its errors for the sheet.

    Args:
        mesh: In the frame of the truth.
        met: Of the rays of the reference view; ``None`` if none meets it.
    """
    truth = inputs.maps
    if met is None or truth.cameras is None:
        return MethodPanels(method=method, note="points only")
    crop = _crop(truth)
    error = error_picture(error_along_rays(met, truth), shade(mesh, truth.cameras))
    return MethodPanels(
        method=method,
        surface=_on_white(view_maps(mesh, truth.cameras, 0, met.hits).normals_cam)[crop],
        error=error[crop],
    )


def scene_row(scene: str, inputs: Inputs, methods: tuple[MethodPanels, ...]) -> SceneRow:
    """Return a scene's row: photograph, truth, and the panels of all methods."""
    maps = inputs.maps
    assert maps.cameras is not None
    assert maps.truth.normals_world is not None
    crop = _crop(maps)
    taken = inputs.scene.views.images[inputs.coarse.reference]
    normals_world = maps.truth.normals_world[0]
    normals_cam = rotate(maps.cameras.cam_from_world[0].to(normals_world), normals_world)
    return SceneRow(
        scene=scene,
        photograph=encoded(taken.movedim(0, -1))[crop],
        truth=_on_white(normals_cam)[crop],
        methods=methods,
    )


def _crop(maps: Capture) -> tuple[slice, slice]:
    assert maps.truth.foreground is not None
    return crop_to(maps.truth.foreground[0])


def error_along_rays(met: Meeting, capture: Capture) -> Float[Tensor, "height width"]:
    """Return the distance of a surface from the truth along the rays of a view, as an error map."""
    assert capture.truth.mesh is not None
    error = torch.full(met.valid.shape, torch.nan, dtype=torch.float64)
    error[met.valid] = torch.inf
    distance = (met.points - met.points_true).norm(dim=-1).double()
    error[met.both] = 100 * distance / bounding_diagonal(capture.truth.mesh)
    return error


def error_picture(
    error: Float[Tensor, "height width"], shading: Float[Tensor, "height width 3"] | None = None
) -> Picture:
    """Colour an error map.

    Args:
        shading: The surface, shaded; tints the colours a little so that height field is seen.

    Returns:
        sRGB. Missed pixels are red, whatever the shading; white where there is nothing.
    """
    from matplotlib import colormaps

    values = error.detach().cpu().double()
    fractions = (values / CLIP_PERCENT).clamp(0, 1).nan_to_num(0)
    colors = colormaps[_COLORS](fractions.numpy())[..., :3]
    if shading is not None:
        tone = shading.detach().cpu().double().mean(dim=-1, keepdim=True).numpy()
        colors = colors * (0.65 + 0.35 * tone)  # darker would hide the colour
    colors[values.isnan().numpy()] = 1
    colors[values.isinf().numpy()] = MISSED
    return np.asarray(colors, dtype=np.float32)


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


def draw_sheet(rows: Sequence[SceneRow], path: Path | str) -> None:
    """Draw scenes by methods as PNG.

    Every scene has two rows of pictures: the photograph and each method's surface above, the
    true normals and each method's errors below. A method has one column in all scenes.

    Args:
        rows: At least one; a method that is missing in one leaves its place empty there.
    """
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
    sheet([*shown, [_bar()]], _PANEL_PX).save(path)


def _on_white(normals_cam: Float[Tensor, "height width 3"]) -> Picture:
    there = (normals_cam != 0).any(dim=-1, keepdim=True)
    return array(torch.where(there, normal_colors(normals_cam), 1.0))


def _bar() -> Tile:
    """Draw the colours of errors in a row, the last of them that of what is missed."""
    height, width = _BAR_PX
    values = torch.linspace(0, CLIP_PERCENT, width).expand(height, width).clone()
    values[:, -width // 10 :] = torch.inf
    return Tile(title=f"{LABEL}; red: missed", picture=error_picture(values), wide=True)
