"""The contact sheet of a run: photographs, silhouettes, facets, normals, albedo, height."""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.projection import project
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records import Cameras, Reconstruction
from pimper_torch.sfm.surfaces import reduced
from pimper_torch.viz.maps import albedo_scale, normal_colors, view_maps
from pimper_torch.viz.render import bounding_box, crop, rotation, shade
from pimper_torch.viz.silhouettes import RELIABLE, thumbnails

Picture = np.ndarray[tuple[int, ...], np.dtype[np.float32]]
Box = tuple[float, float, float, float]  # left, bottom, width, height, fractions of the sheet

_MARGIN = 0.05
_ROTATION_DEG = 40.0
_DIMMED = 0.45
_ACROSS = 4
# Inches of the sheet: width of a panel, room round it, heights of its title and of the sheet's.
_PANEL_IN, _GAP_IN, _TITLE_IN, _HEADLINE_IN = 3.9, 0.1, 0.35, 0.4
_DPI = 100
_PANEL_PX = round(_PANEL_IN * _DPI)
_THUMBNAILS_ACROSS = 8
_MAX_FACES = 200_000  # more than a panel has pixels to show; rays take four times as long at 10^6
_TALLEST = 1.6  # a panel that is higher for its width is shown narrower


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """One picture of the sheet.

    Attributes:
        title: Above it.
        picture: sRGB in [0, 1], rows first.
        lines: Triangles to draw over it, pixels of ``picture``.
        inside: Probability of the object, of which the silhouette is drawn over it.
    """

    title: str
    picture: Picture
    lines: Picture | None = None
    inside: Picture | None = None


def draw_overview(result: Reconstruction, path: Path | str, panel_px: int = _PANEL_PX) -> None:
    """Draw the contact sheet of a run as PNG.

    Shown in the reference view, cropped to the object: the photograph, the facets over it
    and shaded, the normals and albedo that the mesh carries, the mesh's own shape shaded,
    and that again from 40 degrees to the left and to the right. Where silhouettes are known they
    are drawn over the photograph, and below over small photographs of all views, red where a
    view is not trusted.

    Args:
        path: Ends in ``.png``.
        panel_px: Width of a rendered picture.
    """
    # Local, so that importing the package does not load matplotlib; Figure without pyplot
    # leaves no global state behind.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    shown = panels(result, panel_px)
    boxes, size = _boxes(shown)
    below = _all_views(result)
    if below is not None:
        shown = [*shown, below]
        boxes, size = _with_band(boxes, size, below)
    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
    figure.suptitle(headline(result), fontsize=13, y=1 - 0.25 * _HEADLINE_IN / size[1])
    for panel, box in zip(shown, boxes, strict=True):
        axes = figure.add_axes(box)
        height, width = panel.picture.shape[:2]
        axes.imshow(panel.picture, extent=(0, width, height, 0), interpolation="antialiased")
        if panel.inside is not None and _has_border(panel.inside):
            at = np.arange(width) + 0.5, np.arange(height) + 0.5
            axes.contour(*at, panel.inside, levels=[0.5], colors=[RELIABLE], linewidths=0.8)
        if panel.lines is not None:
            axes.add_collection(
                PolyCollection(
                    list(panel.lines), facecolors="none", edgecolors="#ffd24a", linewidths=0.6
                )
            )
        axes.set_title(panel.title, fontsize=11)
        axes.set_axis_off()
        axes.set_anchor("N")
    with warnings.catch_warnings():
        # Names in scripts that the font lacks are drawn as boxes; the files have them.
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        figure.savefig(path, dpi=_DPI, facecolor="white", pil_kwargs={"compress_level": 3})


def _boxes(shown: list[Panel]) -> tuple[list[Box], tuple[float, float]]:
    """Lay panels out in rows as high as their highest.

    Returns:
        Left, bottom, width and height of every panel as fractions of the sheet, and the
        sheet's width and height in inches.
    """
    ratios = [min(panel.picture.shape[0] / panel.picture.shape[1], _TALLEST) for panel in shown]
    rows = [ratios[first : first + _ACROSS] for first in range(0, len(ratios), _ACROSS)]
    heights = [_PANEL_IN * max(row) for row in rows]
    width = _ACROSS * (_PANEL_IN + _GAP_IN)
    height = _HEADLINE_IN + sum(heights) + len(rows) * (_TITLE_IN + _GAP_IN)
    boxes, bottom = [], height - _HEADLINE_IN
    for row, tall in zip(rows, heights, strict=True):
        bottom -= _TITLE_IN + tall
        for column in range(len(row)):
            left = _GAP_IN / 2 + column * (_PANEL_IN + _GAP_IN)
            boxes.append((left / width, bottom / height, _PANEL_IN / width, tall / height))
        bottom -= _GAP_IN
    return boxes, (width, height)


def _with_band(
    boxes: list[Box], size: tuple[float, float], band: Panel
) -> tuple[list[Box], tuple[float, float]]:
    """Make room for a panel as wide as the sheet below the others."""
    width, height = size
    inner = width - _GAP_IN
    tall = inner * band.picture.shape[0] / band.picture.shape[1]
    total = height + _TITLE_IN + tall + _GAP_IN
    raised = [
        (left, (bottom * height + total - height) / total, wide, high * height / total)
        for left, bottom, wide, high in boxes
    ]
    lowest = (_GAP_IN / 2 / width, _GAP_IN / total, inner / width, tall / total)
    return [*raised, lowest], (width, total)


def _all_views(result: Reconstruction) -> Panel | None:
    """Show all photographs with their silhouettes; nothing where there are none."""
    silhouettes = result.silhouettes
    if silhouettes.source == "everything":
        return None
    width_px = _ACROSS * _PANEL_PX
    tiles = thumbnails(
        result.scene.views, silhouettes, width_px=width_px, across=_THUMBNAILS_ACROSS
    )
    origin = "masks given" if silhouettes.source == "masks" else "silhouettes found"
    reliable = f"{int(silhouettes.reliable.sum())} of {len(silhouettes.reliable)} views trusted"
    return Panel(title=f"{origin}, {reliable}", picture=_array(tiles))


def _has_border(inside: Picture) -> bool:
    return bool(inside.min() < 0.5 < inside.max())


def panels(result: Reconstruction, panel_px: int) -> list[Panel]:
    """Make the pictures of the contact sheet."""
    reference = result.coarse.reference
    own = result.cameras.take([reference])
    shape = reduced(result.mesh, _MAX_FACES)
    vertices = result.mesh.vertices_world
    camera = _framed(own, vertices, panel_px)
    name = result.scene.views.names[reference]
    photograph, facets, inside = _photograph(result, own)
    maps = view_maps(result.mesh, camera, 0)
    albedo = (albedo_scale(result.mesh) * maps.albedo).clamp(0, 1)
    center = vertices.mean(dim=0)
    sides = [
        _framed(rotation(own, center, angle), vertices, panel_px)
        for angle in (-_ROTATION_DEG, _ROTATION_DEG)
    ]
    coarse = result.coarse.mesh
    return [
        Panel(title=f"photograph {name}", picture=photograph, inside=inside),
        Panel(
            title=f"{len(coarse.faces)} facets on {len(coarse.vertices_world)} points",
            picture=_DIMMED * photograph,
            lines=facets,
        ),
        Panel(title="facets, shaded", picture=_array(shade(coarse, camera, flat=True))),
        Panel(title="surface, shaded", picture=_array(shade(shape, camera))),
        Panel(title="normals", picture=_array(normal_colors(maps.normals_cam))),
        Panel(title="albedo", picture=_array(_rgb(srgb_from_linear(albedo)))),
        Panel(
            title=f"surface from {_ROTATION_DEG:.0f}° left", picture=_array(shade(shape, sides[0]))
        ),
        Panel(
            title=f"surface from {_ROTATION_DEG:.0f}° right", picture=_array(shade(shape, sides[1]))
        ),
    ]


def _framed(camera: Cameras, vertices: Float[Tensor, "vertex 3"], width_px: int) -> Cameras:
    """Crop a camera's picture to the object, at the size that its panel has on the sheet."""
    low, high = bounding_box(camera, vertices, _MARGIN)
    width, height = (high - low).tolist()
    return crop(camera, low, high, round(width_px * min(max(height / width, 1.0), _TALLEST)))


def headline(result: Reconstruction) -> str:
    """State in a line what went in and what came out."""
    taken = result.scene.views.num_views
    given = taken + len(result.scene.unregistered)
    seconds = sum(report.seconds for report in result.report)
    doubtful = " (cameras doubtful)" if result.scene.doubt else ""
    return (
        f"{taken} of {given} photographs{doubtful}, {len(result.coarse.mesh.faces)} facets, "
        f"{len(result.mesh.vertices_world):,} vertices, {seconds:.0f} s"
    )


def _photograph(result: Reconstruction, own: Cameras) -> tuple[Picture, Picture, Picture | None]:
    """Crop the reference photograph and its silhouette to the object, and project the facets."""
    reference = result.coarse.reference
    width, height = (int(side) for side in own.sizes_px[0])
    low, high = bounding_box(own, result.mesh.vertices_world, _MARGIN)
    left, top = (max(0, int(corner)) for corner in low.floor())
    right, bottom = (int(corner) for corner in high.ceil())
    crop = slice(top, min(bottom, height)), slice(left, min(right, width))
    image = result.scene.views.images[reference][:, *crop].movedim(0, -1)
    everything = result.silhouettes.source == "everything"
    inside = None if everything else _array(result.silhouettes.inside[reference][crop])
    coarse = result.coarse.mesh
    pixels, _ = project(coarse.vertices_world, own.cam_from_world[0], own.intrinsics[0])
    corners = (pixels - pixels.new_tensor([left, top]))[coarse.faces]
    return _array(_rgb(srgb_from_linear(image.clamp(0, 1)))), _array(corners), inside


def _rgb(colors: Float[Tensor, "height width channel"]) -> Float[Tensor, "height width 3"]:
    return colors.expand(*colors.shape[:2], 3)


def _array(values: Float[Tensor, "*batch"]) -> Picture:
    array: Picture = values.detach().cpu().float().numpy()
    return array
