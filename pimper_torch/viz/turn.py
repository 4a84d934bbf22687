"""An animated image of a rotating surface, for browsers and file managers."""

import math
from io import BytesIO
from pathlib import Path

import torch
from PIL import Image
from torch.nn.functional import avg_pool2d, normalize

from pimper_torch.geometry.pinholes import look_at, pinholes, up_world
from pimper_torch.geometry.rigid import rotate
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.visibility import cast_view
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.radiometry.base_color import albedo_scale
from pimper_torch.records import Cameras, Mesh
from pimper_torch.records.shapes import Vector
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.viz.render import lambertian, tone

# Choices: a turn in three seconds, seen from slightly above, in 0.2 MB.
_FRAMES, _FRAME_MS = 30, 100
_OVERSAMPLING = 2
_ELEVATION_DEG, _FOV_DEG, _MARGIN = 15.0, 30.0, 1.03
_QUALITY, _EXPOSURE = 70, 1.4  # the exposure preserves the albedo's brightness under raking light


@torch.no_grad()
def draw_turn(
    mesh: Mesh, cameras: Cameras, reference: int, path: Path | str | BytesIO, side_px: int = 280
) -> None:
    """Draw one turn of a surface, its shape on the left and its lit albedo on the right.

    The file is an animated WebP with transparent background. The light moves with the viewer.

    Args:
        cameras: Of the photographs; they determine up.
        reference: View from whose side the turn starts.
    """
    mesh, cameras = mesh.to("cpu"), cameras.to("cpu")
    start = cameras.centers_world[reference]
    circle = circling(mesh, up_world(cameras), start, _FRAMES, side_px * _OVERSAMPLING)
    normals = vertex_normals(mesh.vertices_world, mesh.faces)
    colors = torch.full_like(normals, 0.5) if mesh.albedo is None else mesh.albedo
    colors = albedo_scale(mesh) * colors.expand(-1, 3)
    look = torch.cat([normals, colors], dim=1)

    def drawn(view: int) -> Image.Image:
        """Draw the shape and the lit albedo side by side, with anti-aliasing."""
        hits, pose = cast_view(mesh, circle, view), circle.cam_from_world[view]
        visible = hits.face >= 0
        values = hits.take(visible).interpolate(look, mesh.faces)
        shading = lambertian(normalize(rotate(pose, values[:, :3]), dim=-1))[:, None]
        lit = srgb_from_linear((_EXPOSURE * shading * values[:, 3:]).clamp(0, 1))
        layers = visible.float().repeat(4, 2, 1, 1)
        layers[:3, :, visible] = torch.stack([tone(shading).expand_as(lit), lit]).movedim(-1, 0)
        colors = avg_pool2d(layers.transpose(1, 2).flatten(2), _OVERSAMPLING).movedim(0, -1)
        opacity = colors[..., 3:]
        image = torch.cat([colors[..., :3] / opacity.clamp_min(1e-6), opacity], dim=-1)
        return Image.fromarray((255 * image).round().to(torch.uint8).numpy())

    frames = list(side_by_side(drawn, range(_FRAMES), tracked=False))
    frames[0].save(
        path,
        "WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=_FRAME_MS,
        loop=0,
        quality=_QUALITY,
        method=2,
    )


def circling(mesh: Mesh, up: Vector, start: Vector, number: int, side_px: int) -> Cameras:
    """Return square pinholes on a circle around a mesh, looking at it.

    Args:
        up: Unit, world frame.
        start: World point; the first pinhole is on its side of the mesh.
        number: Number of cameras, equally spaced.
    """
    low, high = mesh.vertices_world.amin(dim=0), mesh.vertices_world.amax(dim=0)
    center = (low + high) / 2
    radius = float((mesh.vertices_world - center).norm(dim=1).max())
    front = start - center
    front = normalize(front - (front @ up) * up, dim=0)
    side = torch.linalg.cross(up, front)
    elevation = math.radians(_ELEVATION_DEG)
    angles = torch.arange(number).to(up) * (2 * math.pi / number)
    horizontal = angles.cos()[:, None] * front + angles.sin()[:, None] * side
    half = math.radians(_FOV_DEG) / 2
    back = math.cos(elevation) * horizontal + math.sin(elevation) * up
    eyes = center + _MARGIN * radius / math.sin(half) * back
    focal_px = side_px / 2 / math.tan(half)
    return pinholes(look_at(eyes, center, up), focal_px, side_px, side_px)
