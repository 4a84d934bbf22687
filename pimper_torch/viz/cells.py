"""Records in cells of notebooks: a small picture and a table of the fields."""

from html import escape
from pathlib import Path

import torch
from PIL import Image

from pimper_torch.chains.chain import Step
from pimper_torch.radiometry.base_color import albedo_scale
from pimper_torch.records import Mesh, Reconstruction, Record, Silhouettes, SparseScene, Views
from pimper_torch.viz import tiles
from pimper_torch.viz.maps import normal_colors, view_maps
from pimper_torch.viz.overview import framed, preview, shown_views, thumbnail_sheet

LAMP = Path(__file__).with_name("lamp.html").read_text(encoding="utf-8")
"""Disc that sets the direction of a light; it writes into the text field before it."""
# Choices: a cell has at most half a megabyte.
_WIDTH_PX, _HEIGHT_PX = 640, 180


def cell(record: Record) -> str | None:
    """Return HTML of views, a scene, a step or a result; ``None`` for other records."""
    if isinstance(record, Reconstruction):
        return lit_cell(record, record.mesh, record.scene, record.coarse.reference)
    if isinstance(record, Step):
        drawn = preview(record.scene, record.surface.mesh, record.coarse.reference, _HEIGHT_PX)
    elif isinstance(record, SparseScene) and len(record.points_world) > 10:  # others are outermost
        drawn = preview(record, None, 0, _HEIGHT_PX)
    elif isinstance(record, Views | SparseScene):
        drawn = _thumbnails(record if isinstance(record, Views) else record.views)
    else:
        return None
    return f'<img src="{tiles.data_url(drawn)}">{_table(record)}'


def lit_cell(record: Record, mesh: Mesh, scene: SparseScene, reference: int) -> str:
    """Return HTML of a result: the surface in a view, under a light that a disc moves, and a table.

    Pixels are lit by their normals and albedo, without shadows.
    """
    camera, mesh = scene.cameras.take([reference]).detach().to("cpu"), mesh.detach().to("cpu")
    maps = view_maps(mesh, framed(camera, mesh.vertices_world, _WIDTH_PX // 2), 0)
    normals = tiles.image_of(tiles.array(normal_colors(maps.normals_cam)))
    albedo = tiles.image_of(tiles.encoded(albedo_scale(mesh) * maps.albedo))
    page = Path(__file__).with_name("lit.html").read_text(encoding="utf-8").replace("{lamp}", LAMP)
    page = page.replace("{normals}", tiles.data_url(normals, "PNG"))
    page = page.replace("{albedo}", tiles.data_url(albedo))
    style = f"border: 0; width: {normals.width + 130}px; height: {normals.height}px"
    frame = f'<iframe sandbox="allow-scripts" style="{style}" srcdoc="{escape(page)}"></iframe>'
    return frame + _table(record)


def _thumbnails(views: Views) -> Image.Image:
    """Draw at most 64 photographs, with the outlines of their masks."""
    masks = views.inside if views.masks is None else views.masks
    trusted = torch.ones(views.num_views, dtype=torch.bool)
    silhouettes = Silhouettes(inside=masks.float(), reliable=trusted, source="masks")
    sheet = thumbnail_sheet(views, silhouettes, shown_views(trusted), width_px=_WIDTH_PX)
    return tiles.image_of(tiles.array(sheet))


def _table(record: Record) -> str:
    """Return the lines of a record as an HTML table, below its verdict if it has one."""
    title, *lines = str(record).splitlines()
    cells = (escape(line.strip()).replace(": ", "</th><td>", 1) for line in lines)
    rows = "".join(f'<tr style="text-align: left"><th>{cell}</td></tr>' for cell in cells)
    verdict = getattr(record, "verdict", None)
    about = f"<p>{escape(verdict.text)}</p>" if verdict is not None else ""
    return f"<p><b>{title}</b></p>{about}<table>{rows}</table>"
