"""Shaded images of a mesh that show only its geometry."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import rigid, rotate, transform
from pimper_torch.geometry.surfaces import unit_face_normals, vertex_normals
from pimper_torch.geometry.visibility import cast_view
from pimper_torch.records import Cameras, Mesh
from pimper_torch.records.shapes import Points, Scalars, Vectors

Pixel = Float[Tensor, " 2"]

# Raking light from the upper left shows the relief; a weaker one next to the viewer brightens the
# far side.
_POINT_LIGHTS_CAM = ((0.62, (-0.60, -0.60, -0.53)), (0.26, (0.0, 0.0, -1.0)))
_INSIDE = (0.55, 0.62, 0.75)  # tint of faces seen from behind


def shade(mesh: Mesh, camera: Cameras, *, flat: bool = False) -> Float[Tensor, "height width 3"]:
    """Draw a mesh as a grey matte surface under raking light. Not differentiable.

    Shading is computed from the geometry, never from the mesh's stored normals, so visible relief
    exists. Faces seen from behind are bluish.

    Args:
        flat: One tone per face; otherwise, tones are interpolated between vertices, with the mean
            normals of their faces.

    Returns:
        sRGB in [0, 1], white off the mesh.
    """
    fine = camera.replace(
        intrinsics=scale_intrinsics(camera.intrinsics, 2.0, 2.0), sizes_px=camera.sizes_px * 2
    )
    hits = cast_view(mesh, fine, 0)
    visible = hits.face >= 0
    per_face = unit_face_normals(mesh.vertices_world, mesh.faces)
    corners = mesh.vertices_world[mesh.faces]
    from_behind = ((corners[:, 0] - fine.centers_world[0]) * per_face).sum(dim=-1) > 0
    normals = per_face[:, None].expand_as(corners)
    if not flat:
        normals = vertex_normals(mesh.vertices_world, mesh.faces)[mesh.faces]
    normals_cam = rotate(
        fine.cam_from_world, torch.where(from_behind[:, None, None], -normals, normals)
    )
    light = lambertian(normals_cam)
    tint = torch.where(from_behind[:, None], light.new_tensor(_INSIDE), 1.0)
    face = hits.face[visible]
    blended = (hits.barycentric[visible] * light[face]).sum(dim=-1, keepdim=True)
    radiance = torch.ones_like(hits.barycentric)
    radiance[visible] = blended * tint[face]
    radiance = avg_pool2d(radiance.movedim(-1, 0)[None], 2)[0].movedim(0, -1)
    return tone(radiance)


def tone(radiance: Scalars) -> Scalars:
    """Encode the radiance of matte surfaces for a display, in [0, 1].

    The curve is flatter than sRGB's, which shows more of the shape.
    """
    return radiance.clamp(0, 1) ** (1 / 1.3)


def lambertian(normals_cam: Vectors) -> Scalars:
    """Return the radiance of white matte surfaces under the lights of all renderings.

    Args:
        normals_cam: Unit, camera frame.
    """
    light = torch.full_like(normals_cam[..., 0], 0.04)
    for strength, direction in _POINT_LIGHTS_CAM:
        towards = normalize(normals_cam.new_tensor(direction), dim=0)
        light = light + strength * (normals_cam @ towards).clamp_min(0)
    return light


def orbit(camera: Cameras, center_world: Float[Tensor, " 3"], angle_deg: float) -> Cameras:
    """Rotate a camera around a point, about the image's vertical axis.

    Args:
        center_world: The point; its pixel and distance do not change.
        angle_deg: Positive moves to the right and shows the object's right side.
    """
    angle = math.radians(angle_deg)
    cos, sin = math.cos(angle), math.sin(angle)
    about_y = center_world.new_tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    center_cam = transform(camera.cam_from_world[0], center_world[None])[0]
    rotated_from_cam = rigid(about_y, center_cam - about_y @ center_cam)
    return camera.replace(cam_from_world=rotated_from_cam[None] @ camera.cam_from_world)


def crop_to(camera: Cameras, points_world: Points, longer_side_px: int, margin: float) -> Cameras:
    """Crop and scale a camera's image to the bounding box of points.

    Args:
        points_world: At least one is in front of the camera.
        margin: Around the box, as a fraction of its longer side.
    """
    return crop(camera, *image_bounds(camera, points_world, margin), longer_side_px)


def crop(camera: Cameras, low: Pixel, high: Pixel, longer_side_px: int) -> Cameras:
    """Crop and scale a camera's image to a rectangle.

    Args:
        low: Upper left corner, pixels; the rectangle may extend beyond the image.
    """
    factor = longer_side_px / float((high - low).detach().max())
    cropped = camera.intrinsics.clone()
    cropped[:, :2, 2] = cropped[:, :2, 2] - low
    sides = ((high - low) * factor).round().clamp_min(1).long()
    intrinsics = scale_intrinsics(cropped, factor, factor)
    return camera.replace(intrinsics=intrinsics, sizes_px=sides[None])


def image_bounds(camera: Cameras, points_world: Points, margin: float) -> tuple[Pixel, Pixel]:
    """Return the corners (top left, bottom right) of the points' bounding box in pixels."""
    pixels, depth = project(points_world, camera.cam_from_world[0], camera.intrinsics[0])
    pixels = pixels[depth > 0]
    low, high = pixels.amin(dim=0), pixels.amax(dim=0)
    padding = margin * (high - low).max().clamp_min(1)
    return low - padding, high + padding
