"""Shaded pictures of a mesh, honest about its geometry."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from pimper_torch.ground.geometry.pixels import scale_intrinsics
from pimper_torch.ground.geometry.projection import project
from pimper_torch.ground.geometry.rigid import rigid, rotate, transform
from pimper_torch.ground.geometry.surfaces import unit_face_normals, vertex_normals
from pimper_torch.ground.geometry.visibility import cast_view
from pimper_torch.ground.shapes import Points, Scalars, Vectors
from pimper_torch.records import Cameras, Mesh

Pixel = Float[Tensor, " 2"]

# Raking light from up on the left shows the relief; a weaker one next to the viewer keeps the far
# side from drowning.
_POINT_LIGHTS_CAM = ((0.62, (-0.60, -0.60, -0.53)), (0.26, (0.0, 0.0, -1.0)))
_INSIDE = (0.55, 0.62, 0.75)  # tint of faces seen from behind


def shade(mesh: Mesh, camera: Cameras, *, flat: bool = False) -> Float[Tensor, "height width 3"]:
    """Draw a mesh as grey matte stuff under a raking point light.

    Its own shape is shaded, never the normals that it carries: relief that is seen is there.
    Faces seen from behind are bluish. A constant to autograd.

    Args:
        flat: Every face has one tone; else tones are blended between vertices, whose normals are
            their faces' mean.

    Returns:
        sRGB in [0, 1], white where nothing is seen.
    """
    fine = camera.replace(
        intrinsics=scale_intrinsics(camera.intrinsics, 2.0, 2.0), sizes_px=camera.sizes_px * 2
    )
    hits = cast_view(mesh, fine, 0)
    seen = hits.face >= 0
    per_face = unit_face_normals(mesh.vertices_world, mesh.faces)
    corners = mesh.vertices_world[mesh.faces]
    from_behind = ((corners[:, 0] - fine.centers_world[0]) * per_face).sum(dim=-1) > 0
    shown = per_face[:, None].expand_as(corners)
    if not flat:
        shown = vertex_normals(mesh.vertices_world, mesh.faces)[mesh.faces]
    normals_cam = rotate(
        fine.cam_from_world, torch.where(from_behind[:, None, None], -shown, shown)
    )
    light = lambertian(normals_cam)
    tint = torch.where(from_behind[:, None], light.new_tensor(_INSIDE), 1.0)
    face = hits.face[seen]
    blended = (hits.barycentric[seen] * light[face]).sum(dim=-1, keepdim=True)
    radiance = torch.ones_like(hits.barycentric)
    radiance[seen] = blended * tint[face]
    radiance = avg_pool2d(radiance.movedim(-1, 0)[None], 2)[0].movedim(0, -1)
    return tone(radiance)


def tone(radiance: Scalars) -> Scalars:
    """Encode the radiance of matte surfaces for a display, in [0, 1].

    Well short of a display's curve: steeper tones show more of the shape.
    """
    return radiance.clamp(0, 1) ** (1 / 1.3)


def lambertian(normals_cam: Vectors) -> Scalars:
    """Return the radiance of white matte surfaces under the lights of all pictures.

    Args:
        normals_cam: Unit, camera frame.
    """
    light = torch.full_like(normals_cam[..., 0], 0.04)
    for strength, direction in _POINT_LIGHTS_CAM:
        towards = normalize(normals_cam.new_tensor(direction), dim=0)
        light = light + strength * (normals_cam @ towards).clamp_min(0)
    return light


def rotation(camera: Cameras, center_world: Float[Tensor, " 3"], angle_deg: float) -> Cameras:
    """Move a camera around a point, about the vertical of the picture.

    Args:
        center_world: The point, which stays at its pixel and its distance.
        angle_deg: Positive moves to the right and shows the object's right side.
    """
    angle = math.radians(angle_deg)
    cos, sin = math.cos(angle), math.sin(angle)
    about_y = center_world.new_tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    center_cam = transform(camera.cam_from_world[0], center_world[None])[0]
    rotated_from_cam = rigid(about_y, center_cam - about_y @ center_cam)
    return camera.replace(cam_from_world=rotated_from_cam[None] @ camera.cam_from_world)


def frame(camera: Cameras, points_world: Points, longer_side_px: int, margin: float) -> Cameras:
    """Crop and scale a camera's picture to the bounding box of some points.

    Args:
        points_world: At least one of them in front of the camera.
        margin: Around the box, as a fraction of its longer side.
    """
    return crop(camera, *bounding_box(camera, points_world, margin), longer_side_px)


def crop(camera: Cameras, low: Pixel, high: Pixel, longer_side_px: int) -> Cameras:
    """Crop and scale a camera's picture to a rectangle.

    Args:
        low: Upper left corner, pixels; the rectangle may be outside of the picture.
    """
    factor = longer_side_px / float((high - low).detach().max())
    cropped = camera.intrinsics.clone()
    cropped[:, :2, 2] = cropped[:, :2, 2] - low
    sides = ((high - low) * factor).round().clamp_min(1).long()
    intrinsics = scale_intrinsics(cropped, factor, factor)
    return camera.replace(intrinsics=intrinsics, sizes_px=sides[None])


def bounding_box(camera: Cameras, points_world: Points, margin: float) -> tuple[Pixel, Pixel]:
    """Return the corners (top left, bottom right) of the pixels that some points cover."""
    pixels, depth = project(points_world, camera.cam_from_world[0], camera.intrinsics[0])
    pixels = pixels[depth > 0]
    low, high = pixels.amin(dim=0), pixels.amax(dim=0)
    room = margin * (high - low).max().clamp_min(1)
    return low - room, high + room
