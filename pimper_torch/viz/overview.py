"""The contact sheet of a run: photographs, silhouettes, facets, normals, albedo, height."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate, max_pool2d, pad

from pimper_torch.geometry.poisson import reduced
from pimper_torch.geometry.projection import project
from pimper_torch.radiometry import srgb_from_linear, to_bytes
from pimper_torch.radiometry.base_color import albedo_scale
from pimper_torch.records import Mesh, Reconstruction, Silhouettes
from pimper_torch.records.scene import SparseScene
from pimper_torch.records.shapes import Mask, Points, Vertices
from pimper_torch.records.views import Cameras, Views
from pimper_torch.runtime.mapped import drop_pages
from pimper_torch.stages.sfm.sparse_scene import point_colors
from pimper_torch.viz import tiles
from pimper_torch.viz.maps import normal_colors, view_maps
from pimper_torch.viz.render import crop, crop_to, image_bounds, orbit, shade

_ACROSS, _PANEL_PX = 4, 390
_FACETS = "#ffd24a"
_MOST_THUMBNAILS = 64


def draw_overview(
    result: Reconstruction, path: Path | str | BytesIO, panel_px: int = _PANEL_PX
) -> None:
    """Draw the contact sheet of a run as PNG; see :func:`overview`."""
    overview(result, panel_px).save(path, "PNG", compress_level=3)


def overview(result: Reconstruction, panel_px: int = _PANEL_PX) -> Image.Image:
    """Draw the contact sheet of a run; ``result.plot()`` is the same.

    The sheet has, in the reference view, cropped to the object: the photograph, the facets over it
    and shaded, the mesh's normals and albedo, its shape shaded, and also from 40 degrees to the
    left and to the right. Known silhouettes are drawn over the photograph, and below over small
    photographs of all views, at most 64, in red if a view is unreliable.
    """
    result = result.detach().to("cpu")
    panels = panels_of(result, panel_px)
    rows = [panels[first : first + _ACROSS] for first in range(0, len(panels), _ACROSS)]
    if result.silhouettes.source != "everything":
        rows.append([_all_views(result, _ACROSS * panel_px)])
    return tiles.sheet(rows, panel_px, headline(result))


def panels_of(result: Reconstruction, panel_px: int) -> list[tiles.Tile]:
    """Draw the images of the contact sheet."""
    reference = result.coarse.reference
    full = result.cameras.take([reference])
    shape = reduced(result.mesh, 200_000)  # more faces than a panel's pixels can show
    vertices = result.mesh.vertices_world
    camera = framed(full, vertices, panel_px)
    name = result.scene.views.names[reference]
    photograph, outlined, corners = _photograph(result, full, panel_px)
    maps = view_maps(result.mesh, camera, 0)
    center = vertices.mean(dim=0)
    sides = [framed(orbit(full, center, angle), vertices, panel_px) for angle in (-40.0, 40.0)]
    coarse = result.coarse.mesh
    images = {
        f"photograph {name}": outlined,
        f"{len(coarse.faces)} facets on {len(coarse.vertices_world)} points": tiles.with_triangles(
            0.45 * photograph, corners, _FACETS
        ),
        "facets, shaded": tiles.array(shade(coarse, camera, flat=True)),
        "surface, shaded": tiles.array(shade(shape, camera)),
        "normals": tiles.array(normal_colors(maps.normals_cam)),
        "albedo": tiles.encoded(albedo_scale(result.mesh) * maps.albedo),
        "surface from 40° left": tiles.array(shade(shape, sides[0])),
        "surface from 40° right": tiles.array(shade(shape, sides[1])),
    }
    return [tiles.Tile(title=title, picture=picture) for title, picture in images.items()]


def _all_views(result: Reconstruction, width_px: int) -> tiles.Tile:
    """Draw photographs with their silhouettes: all, or a selection with the unreliable ones."""
    silhouettes = result.silhouettes
    views = shown_views(silhouettes.reliable.cpu())
    small = thumbnail_sheet(result.scene.views, silhouettes, views, width_px=width_px)
    origin = "masks given" if silhouettes.source == "masks" else "silhouettes found"
    count = len(silhouettes.reliable)
    title = f"{origin}, {int(silhouettes.reliable.sum())} of {count} views trusted"
    if len(views) < count:
        title += f", {len(views)} shown"
    return tiles.Tile(title=title, picture=tiles.array(small), wide=True)


def shown_views(reliable: Bool[Tensor, " view"]) -> list[int]:
    """Return the drawn views, in order: unreliable ones, and an even selection of the others."""
    unreliable = (~reliable).nonzero()[:_MOST_THUMBNAILS, 0]
    trusted = reliable.nonzero()[:, 0]
    count = min(len(trusted), _MOST_THUMBNAILS - len(unreliable))
    even = torch.linspace(0, max(0, len(trusted) - 1), count).round().long()
    return torch.cat([unreliable, trusted[even]]).sort().values.tolist()


def framed(camera: Cameras, vertices: Vertices, width_px: int) -> Cameras:
    """Crop a camera's image to the object, at the size of its panel on the sheet."""
    low, high = image_bounds(camera, vertices, 0.05)
    width, height = (high - low).tolist()
    return crop(camera, low, high, round(width_px * min(max(height / width, 1.0), tiles.TALLEST)))


def headline(result: Reconstruction) -> str:
    """Return one line with the numbers of the input and the result."""
    registered = result.scene.views.num_views
    given = registered + len(result.scene.unregistered)
    seconds = sum(report.seconds for report in result.report)
    took = f", {seconds:.0f} s" if result.report else ""
    caveat = " (cameras unreliable)" if result.scene.diagnosis else ""
    return (
        f"{registered} of {given} photographs{caveat}, {len(result.coarse.mesh.faces)} facets, "
        f"{len(result.mesh.vertices_world):,} vertices{took}"
    )


def _photograph(
    result: Reconstruction, camera: Cameras, panel_px: int
) -> tuple[tiles.Picture, tiles.Picture, Float[Tensor, "facet 3 2"]]:
    """Return the cropped reference photograph, the same with its silhouette, and facet corners."""
    reference = result.coarse.reference
    width, height = (int(side) for side in camera.sizes_px[0])
    low, high = image_bounds(camera, result.mesh.vertices_world, 0.05)
    left, top = (max(0, int(corner)) for corner in low.floor())
    right, bottom = (int(corner) for corner in high.ceil())
    box = slice(top, min(bottom, height)), slice(left, min(right, width))
    image = tiles.encoded(result.scene.views.images[reference][:, *box].movedim(0, -1))
    photograph = outlined = tiles.fitted(image, panel_px)
    if result.silhouettes.source != "everything":
        inside = tiles.array(result.silhouettes.inside[reference][box])[..., None]
        drawn = torch.from_numpy(tiles.fitted(inside.repeat(3, axis=-1), panel_px)[..., 0] > 0.5)
        outlined = photograph.copy()
        outlined[border(drawn).numpy()] = RELIABLE
    coarse = result.coarse.mesh
    pixels, _ = project(coarse.vertices_world, camera.cam_from_world[0], camera.intrinsics[0])
    corners = (pixels - pixels.new_tensor([left, top]))[coarse.faces]
    return photograph, outlined, corners * (photograph.shape[1] / image.shape[1])


RELIABLE, UNRELIABLE = (1.0, 0.82, 0.29), (1.0, 0.2, 0.2)


def thumbnail_sheet(
    views: Views, silhouettes: Silhouettes, shown: Sequence[int], *, width_px: int, across: int = 8
) -> Float[Tensor, "height width 3"]:
    """Tile small photographs of some views, each with its silhouette's outline, one pixel wide.

    Args:
        silhouettes: Of the same views. Outlines are yellow, and red for an unreliable view.
        shown: Views, in the order of the tiles.

    Returns:
        sRGB in [0, 1]; unused tiles are white.
    """
    height, width = views.images.shape[-2:]
    wide = max(1, width_px // across)
    high = max(1, round(wide * height / width))
    rows = -(-len(shown) // across)
    tiled = torch.ones(rows * high, across * wide, 3)
    for index, view in enumerate(shown):
        image = adaptive_avg_pool2d(views.images[view].detach().cpu(), (high, wide))
        inside = adaptive_avg_pool2d(silhouettes.inside[view].cpu()[None], (high, wide))[0]
        tile = srgb_from_linear(image.clamp(0, 1)).expand(3, -1, -1).movedim(0, -1).clone()
        tile[border(inside > 0.5)] = tile.new_tensor(
            RELIABLE if silhouettes.reliable[view] else UNRELIABLE
        )
        top, left = index // across * high, index % across * wide
        tiled[top : top + high, left : left + wide] = tile
        drop_pages()
    return tiled


def border(mask: Mask) -> Mask:
    """Return the mask's pixels next to others; the image's edge is not a border."""
    adjacent = max_pool2d((~mask)[None].float(), kernel_size=3, stride=1, padding=1)[0] > 0
    return mask & adjacent


@torch.no_grad()
def preview(
    scene: SparseScene, mesh: Mesh | None, reference: int, panel_px: int = 360
) -> Image.Image:
    """Draw a photograph and three views of the surface.

    Args:
        mesh: None draws the sparse points, except the outermost ones.
        reference: View of the photograph.
        panel_px: Longer side of an image of the surface, and height of the photograph.
    """
    camera = scene.cameras.take([reference]).detach().to("cpu")
    width, height = camera.sizes_px[0].tolist()
    image = scene.views.images[reference, :, :height, :width].cpu()[None]
    size = (panel_px, max(1, round(panel_px * width / height)))
    photograph = interpolate(image, size=size, mode="area")[0].movedim(0, -1)
    if mesh is None:
        points, colors = scene.points_world.detach().cpu(), point_colors(scene).cpu()
        low, high = points.quantile(points.new_tensor([0.05, 0.95]), dim=0)
        inner = ((low <= points) & (points <= high)).all(dim=1)
        points, colors = points[inner], colors[inner]
    else:
        mesh = mesh.detach().to("cpu")
        points = mesh.vertices_world
    panels = [to_bytes(photograph.expand(*size, 3))]
    for angle in (0.0, -40.0, 40.0):
        rotated = crop_to(orbit(camera, points.mean(dim=0), angle), points, panel_px, 0.05)
        if mesh is None:
            drawn = _dots(points, colors, rotated)
        else:
            drawn = (255 * shade(mesh, rotated)).round().to(torch.uint8)
        above = (panel_px - len(drawn)) // 2
        below = panel_px - len(drawn) - above
        panels.append(pad(drawn, (0, 0, 0, 0, above, below), value=255))
    return Image.fromarray(torch.cat(panels, dim=1).numpy())


def _dots(
    points: Points, colors: UInt8[Tensor, "point 3"], camera: Cameras
) -> UInt8[Tensor, "height width 3"]:
    """Draw points as squares of two pixels on white; the nearest ones are drawn last."""
    pixels, depth = project(points, camera.cam_from_world[0], camera.intrinsics[0])
    order = depth.argsort(descending=True)
    order = order[depth[order] > 0]
    width, height = camera.sizes_px[0].tolist()
    drawn = torch.full((height, width, 3), 255, dtype=torch.uint8)
    left, top = pixels[order].long().unbind(dim=1)
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        at = (top + down).clamp(0, height - 1), (left + right).clamp(0, width - 1)
        drawn[at] = colors[order]
    return drawn
