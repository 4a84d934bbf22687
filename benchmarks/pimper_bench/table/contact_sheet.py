"""Error maps of surfaces, and the contact sheet of the bench.

An error map has one value per pixel, per cent of the diagonal of the true bounding box: finite
where measured, infinite where the surface misses a pixel of the truth, NaN where there is nothing
to compare.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_bench.metrics.in_view import Meeting
from pimper_bench.metrics.surface_distances import bounding_diagonal
from pimper_bench.table.bench_inputs import Inputs
from pimper_bench.truth import Capture
from pimper_torch.geometry.rigid import rotate
from pimper_torch.records import Mesh
from pimper_torch.viz.maps import normal_colors, view_maps
from pimper_torch.viz.render import shade
from pimper_torch.viz.tiles import Picture, Tile, array, encoded, sheet

_COLORS = "viridis"  # perceptually uniform, and it has no red
MISSED = (0.88, 0.20, 0.16)
# Upper end of the colour scale: twice the typical error of the facets alone, so that methods
# can be distinguished.
CLIP_PERCENT = 1.0
LABEL = f"distance to the truth, % of the diagonal, 0 to {CLIP_PERCENT:g} (clipped there)"
_PANEL_PX = 400
_BAR_PX = (16, 400)


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodPanels:
    """Images of one method on a scene.

    Attributes:
        surface: Its normals, sRGB, rows first; ``None`` without a surface.
        error: Its error map; ``None`` without one.
        note: Text instead of missing images.
    """

    method: str
    surface: Picture | None = None
    error: Picture | None = None
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneRow:
    """A scene on the sheet: the truth, then one column per method.

    Attributes:
        photograph: sRGB, rows first, of the size of the other images.
    """

    scene: str
    photograph: Picture
    truth: Picture
    methods: tuple[MethodPanels, ...]


def method_panels(mesh: Mesh, met: Meeting | None, inputs: Inputs, method: str) -> MethodPanels:
    """Draw a surface and its errors for the sheet.

    Args:
        mesh: In the frame of the truth.
        met: Intersections of the reference view's rays; ``None`` if no ray meets the mesh.
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
    """Return the row of a scene: photograph, truth, and the images of all methods."""
    maps = inputs.maps
    assert maps.cameras is not None
    assert maps.truth.normals_world is not None
    crop = _crop(maps)
    image = inputs.scene.views.images[inputs.coarse.reference]
    normals_world = maps.truth.normals_world[0]
    normals_cam = rotate(maps.cameras.cam_from_world[0].to(normals_world), normals_world)
    return SceneRow(
        scene=scene,
        photograph=encoded(image.movedim(0, -1))[crop],
        truth=_on_white(normals_cam)[crop],
        methods=methods,
    )


def _crop(maps: Capture) -> tuple[slice, slice]:
    assert maps.truth.foreground is not None
    return crop_to(maps.truth.foreground[0])


def error_along_rays(met: Meeting, capture: Capture) -> Float[Tensor, "height width"]:
    """Return the error map of a surface along the rays of a view."""
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
        shading: Shading of the surface; modulates the colours slightly so that relief is visible.

    Returns:
        sRGB. Missed pixels are red, regardless of the shading; white where nothing is compared.
    """
    from matplotlib import colormaps

    values = error.detach().cpu().double()
    fractions = (values / CLIP_PERCENT).clamp(0, 1).nan_to_num(0)
    colors = colormaps[_COLORS](fractions.numpy())[..., :3]
    if shading is not None:
        tone = shading.detach().cpu().double().mean(dim=-1, keepdim=True).numpy()
        colors = colors * (0.65 + 0.35 * tone)  # darker values would hide the colour
    colors[values.isnan().numpy()] = 1
    colors[values.isinf().numpy()] = MISSED
    return np.asarray(colors, dtype=np.float32)


def crop_to(where: Bool[Tensor, "height width"]) -> tuple[slice, slice]:
    """Return the rows and columns that contain all true pixels, with a margin.

    The complete image if no pixel is true.
    """
    if not bool(where.any()):
        return slice(None), slice(None)
    spans = []
    for axis, size in ((1, where.shape[0]), (0, where.shape[1])):
        indices = torch.nonzero(where.any(dim=axis))[:, 0]
        low, high = int(indices[0]), int(indices[-1]) + 1
        margin = round(0.04 * (high - low)) + 1
        spans.append(slice(max(0, low - margin), min(size, high + margin)))
    return spans[0], spans[1]


def draw_sheet(rows: Sequence[SceneRow], path: Path | str) -> None:
    """Draw scenes by methods as PNG.

    Every scene has two rows of images: the photograph and each method's surface above, the
    true normals and each method's errors below. A method has the same column in all scenes.

    Args:
        rows: At least one; a method that is missing in a scene has empty tiles there.
    """
    names = tuple(dict.fromkeys(panels.method for row in rows for panels in row.methods))
    tiles: list[list[Tile]] = []
    for row in rows:
        of_method = {panels.method: panels for panels in row.methods}
        methods = [of_method.get(name, MethodPanels(method=name)) for name in names]
        above = [Tile(title=f"{row.scene}, photograph", picture=row.photograph)]
        below = [Tile(title="true normals", picture=row.truth)]
        for panels in methods:
            above.append(Tile(title=panels.method, picture=panels.surface, note=panels.note))
            note = "" if panels.surface is None else panels.note  # not twice
            below.append(Tile(picture=panels.error, note=note))
        tiles += [above, below]
    sheet([*tiles, [_bar()]], _PANEL_PX).save(path)


def _on_white(normals_cam: Float[Tensor, "height width 3"]) -> Picture:
    present = (normals_cam != 0).any(dim=-1, keepdim=True)
    return array(torch.where(present, normal_colors(normals_cam), 1.0))


def _bar() -> Tile:
    """Draw the colour bar of errors, which ends with the colour of missed pixels."""
    height, width = _BAR_PX
    values = torch.linspace(0, CLIP_PERCENT, width).expand(height, width).clone()
    values[:, -width // 10 :] = torch.inf
    return Tile(title=f"{LABEL}; red: missed", picture=error_picture(values), wide=True)
